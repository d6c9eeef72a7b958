"""Numbers of things in words."""

from __future__ import annotations

import pytest

from recon.core.text import counted


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0 frames"), (1, "1 frame"), (2, "2 frames"), (-1, "-1 frame"), (1200, "1200 frames")],
)
def test_one_thing_is_no_plural(number: int, text: str) -> None:
    assert counted(number, "frame") == text


def test_a_number_may_be_written_in_another_form() -> None:
    assert counted(1, "frame", form="+d") == "+1 frame"
    assert counted(1200, "point", form=",") == "1,200 points"


def test_some_words_have_a_plural_of_their_own() -> None:
    assert [counted(n, "match", "matches") for n in (1, 2)] == ["1 match", "2 matches"]
