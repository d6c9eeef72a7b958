"""What a page is made of, as values: sections of images, tables, views in 3-D, long texts.

A block that is wide has the whole width of a page, others are two beside each other.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import PIL.Image

from recon.report.scene import Scene

Row = Sequence[str]
NOT_KNOWN: Final = "–"
_NARROW_COLUMNS: Final = 5  # of a table in half of a page
_LATEX: Final = str.maketrans({
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--",
})  # fmt: skip
_HALF_PAGE_PX: Final = 800  # of a figure that has another one beside it


@dataclass(frozen=True, eq=False)
class Image:
    """A figure or a photo, as a PNG file."""

    kind: ClassVar = "image"
    title: str
    png: bytes | None
    caption: str = ""

    @property
    def empty(self) -> bool:
        return not self.png

    @property
    def wide(self) -> bool:
        with PIL.Image.open(io.BytesIO(self.png or b"")) as image:
            return bool(image.width > _HALF_PAGE_PX)


@dataclass(frozen=True, eq=False)
class View3D:
    """A scene to be turned in the page."""

    kind: ClassVar = "view"
    wide: ClassVar = True
    title: str
    scene: Scene | None
    caption: str = ""
    max_points: int = 120_000

    @property
    def empty(self) -> bool:
        return self.scene is None or self.scene.empty


@dataclass(frozen=True)
class Table:
    """A table; the first cell of a row names it. Texts have a head, pages may do without."""

    kind: ClassVar = "table"
    title: str
    head: Row
    rows: Sequence[Row]
    best: Literal["columns", "rows", "nowhere"] = "nowhere"  # where to look for smallest numbers
    caption: str = ""
    links: Mapping[str, str] | None = None  # files to look at, by the name of the row
    bad: Collection[str] = ()  # names of rows that stand out

    @property
    def empty(self) -> bool:
        return not self.rows

    @property
    def wide(self) -> bool:
        return not self.head or len(self.head) > _NARROW_COLUMNS

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


@dataclass(frozen=True, eq=False)
class Text:
    """A long text, which a page shows when it is asked for."""

    kind: ClassVar = "text"
    title: str
    text: str

    @property
    def empty(self) -> bool:
        return not self.text


Block = Image | Table | Text | View3D


@dataclass(frozen=True, eq=False)
class Section:
    """Blocks below a title; those that are empty are left out, and a section of none, too."""

    title: str
    blocks: Sequence[Block]
    intro: str = ""

    @property
    def shown(self) -> list[Block]:
        return [block for block in self.blocks if not block.empty]


@dataclass(frozen=True, eq=False)
class Page:
    """What a report shows.

    Attributes:
        title, subtitle: What the run was.
        figures: Its headline figures, each with its label; one whose text is "" is left out.
        sections: The rest of the page.
        found: Its summary, which has warnings, and may have a verdict.
        warnings: In place of those of the summary.
    """

    title: str
    subtitle: str
    figures: Sequence[tuple[str, str]]
    sections: Sequence[Section]
    found: Mapping[str, Any]
    warnings: Sequence[str] | None = None


def join(texts: Iterable[str]) -> str:
    """Join the texts of tables, with an empty line between two."""
    return "\n\n".join(texts) + "\n"


def csv_text(rows: Iterable[Sequence[Any]]) -> str:
    """Write rows as CSV."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def at(found: Any, *keys: str) -> Any:
    """Return a figure of nested mappings by its keys; None where there is none."""
    for key in keys:
        found = (found or {}).get(key)
    return found


def known(form: str, value: Any, otherwise: str = "") -> str:
    """Return a number in a form, such as ``{:.1f} s``; something else if it is not known."""
    if not is_number(value):
        return otherwise
    text = form.format(value)
    return text if re.search("[1-9]", text) else text.removeprefix("-")  # 0 is no direction


def row_of(name: str, found: Any, columns: Iterable[tuple[str, ...]]) -> Row:
    """Return a row of a table: figures by their forms and keys, or `NOT_KNOWN`."""
    return (name, *(known(form, at(found, *keys), NOT_KNOWN) for form, *keys in columns))


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: float | None, digits: int = 2) -> str:
    """Write a number with fixed digits, or `NOT_KNOWN`."""
    return NOT_KNOWN if value is None else f"{value:.{digits}f}"
