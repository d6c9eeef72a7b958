"""Tables for papers: plain LaTeX, without any package."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Final

_SPECIAL: Final = str.maketrans({
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--",
})  # fmt: skip


def latex_tabular(
    rows: Sequence[Sequence[str]], bold: Collection[tuple[int, int]] = (), *, title: str = ""
) -> str:
    """A ``tabular``: first column to the left, numbers to the right, lines around head and body.

    Args:
        rows: The cells; the first row is the head.
        bold: Row and column of each cell in bold.
        title: Comment above the table.
    """
    head, *body = [
        " & ".join(_cell(text, bold=(r, c) in bold) for c, text in enumerate(row)) + r" \\"
        for r, row in enumerate(rows)
    ]
    comment = [f"% {title}"] if title else []
    begin = rf"\begin{{tabular}}{{l{'r' * (len(rows[0]) - 1)}}}"
    lines = [*comment, begin, r"\hline", head, r"\hline", *body, r"\hline", r"\end{tabular}"]
    return "\n".join(lines)


def _cell(text: str, *, bold: bool) -> str:
    escaped = text.translate(_SPECIAL)
    return rf"\textbf{{{escaped}}}" if bold else escaped
