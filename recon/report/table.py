"""A table, and its text for terminals, Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

Row = Sequence[str]
NOT_KNOWN: Final = "–"
_LATEX: Final = str.maketrans({
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--",
})  # fmt: skip


@dataclass(frozen=True)
class Table:
    """A table with a head; the first cell of a row names it."""

    title: str
    head: Row
    rows: Sequence[Row]
    best: Literal["columns", "rows", "nowhere"] = "nowhere"  # where to look for smallest numbers

    def text(self) -> str:
        """Return the table in columns, for a terminal."""
        lines = [self.head, *self.rows]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        padded = (
            "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])])
            for line in lines
        )
        return "\n".join([self.title, *(line.rstrip() for line in padded)])

    def markdown(self) -> str:
        rule = ["---", *["---:"] * (len(self.head) - 1)]
        rows = ([cell.replace("|", r"\|") for cell in row] for row in (self.head, rule, *self.rows))
        lines = [f"| {' | '.join(row)} |" for row in rows]
        return "\n".join([f"### {self.title}", *lines])

    def latex(self) -> str:
        """Write the table as a ``tabular`` of plain LaTeX, the best of several numbers in bold."""
        best = self._best_cells()
        lines = []
        for r, row in enumerate([self.head, *self.rows], start=-1):
            cells = [cell.translate(_LATEX) for cell in row]
            bold = (rf"\textbf{{{x}}}" if (r, c) in best else x for c, x in enumerate(cells))
            lines.append(" & ".join(bold) + r" \\")
        head, *body = lines
        begin = rf"\begin{{tabular}}{{l{'r' * (len(self.head) - 1)}}}"
        lines = [f"% {self.title}", begin, r"\hline", head, r"\hline", *body, r"\hline"]
        return "\n".join([*lines, r"\end{tabular}"])

    def _best_cells(self) -> set[tuple[int, int]]:
        """Return row and column of the smallest number, as it is shown, of each line of several."""
        lines: dict[int, dict[tuple[int, int], float]] = {}
        for r, row in enumerate(self.rows if self.best != "nowhere" else ()):
            for c, cell in enumerate(row):
                if c and cell != NOT_KNOWN:
                    line = lines.setdefault(c if self.best == "columns" else r, {})
                    line[r, c] = float(cell.removesuffix(" %"))
        return {
            place
            for line in lines.values()
            if len(line) > 1
            for place, number in line.items()
            if number == min(line.values())
        }


def join(texts: Iterable[str]) -> str:
    """Join the texts of tables, with an empty line between two."""
    return "\n\n".join(texts) + "\n"


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Write rows as CSV."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def number(value: float | None, digits: int = 2) -> str:
    """Write a number with fixed digits, or `NOT_KNOWN`."""
    return NOT_KNOWN if value is None else f"{value:.{digits}f}"
