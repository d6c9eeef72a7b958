"""Words that depend on a number."""

from __future__ import annotations


def counted(number: int, one: str, many: str = "", *, form: str = "") -> str:
    """Return a number of things, such as ``1 frame``, ``2 frames`` or, signed, ``-1 frame``.

    Args:
        number: How many.
        one: What one of them is called.
        many: What several are called, if that is not the same with an s.
        form: How the number is written, such as ``,`` for commas between thousands.
    """
    return f"{number:{form}} {one if abs(number) == 1 else many or one + 's'}"
