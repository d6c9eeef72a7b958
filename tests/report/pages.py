"""Reads pages: what they load, their text, and the titles of their figures."""

from __future__ import annotations

import re
from html import unescape
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import ClassVar

from recon.report.map_page import map_content
from recon.report.page import render_page
from recon.report.pair_page import pair_content

LOADING = {"src", "href", "data", "action", "poster", "srcset", "xlink:href"}


class Loads(HTMLParser):
    """Collects what a page would load, its text, and the elements that stay open."""

    VOID: ClassVar = frozenset({"meta", "img", "br", "wbr", "link", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in LOADING]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def parse(page: str) -> Loads:
    parser = Loads()
    parser.feed(page)
    parser.close()
    return parser


def blocks(page: str) -> dict[str, str]:
    """The HTML of each block by its title."""
    found = re.findall(
        r"<figure class=\"block[^>]*>\s*<h3>(.*?)</h3>(.*?)</figure>", page, re.DOTALL
    )
    return {unescape(title): inside for title, inside in found}


def images(page: str) -> set[str]:
    """Titles of the blocks that are images."""
    return {title for title, inside in blocks(page).items() if "<img" in inside}


def key_figures(page: str) -> dict[str, str]:
    """The key figures of a page."""
    found = re.findall(r"<div><dt>(.*?)</dt><dd>(.*?)</dd></div>", page)
    return {unescape(label): unescape(value) for label, value in found}


def rows(block: str) -> list[tuple[str, ...]]:
    """The cells of a table's body."""
    body = re.findall(r"<tr>(.*?)</tr>", block.rpartition("<tbody>")[2], re.DOTALL)
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL) for row in body]
    return [tuple(unescape(cell.replace("<wbr>", "")) for cell in row) for row in cells]


def map_html(run: SimpleNamespace) -> str:
    content = map_content(run.map_, run.made, run.errors, run.sample)
    return render_page("map", found=run.summary, warnings=run.summary["warnings"], **content)


def pair_html(run: SimpleNamespace) -> str:
    return render_page("pair", found=run.summary, warnings=run.warnings, **pair_content(run))  # type: ignore[arg-type]
