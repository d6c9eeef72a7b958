"""Links between pages lead to a file, and to a heading in it; every command has its place."""

import re
from pathlib import Path

import pytest
import typer.main

from recon import cli
from tests.docs.blocks import PAGES, ROOT

LINK = re.compile(r"\]\(((?!https?:|mailto:)[^)\s]*)\)")
FENCED = re.compile(r"^( *)```.*?^\1```$", re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Those of the headings of a page, as they are made from them: words joined by hyphens."""
    headings = re.findall(r"^#+ (.*)$", FENCED.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_link_leads_somewhere(page):
    astray = []
    for link in LINK.findall(FENCED.sub("", page.read_text())):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            astray.append(link)
    assert astray == []


def test_the_code_names_pages_that_there_are():
    files = [*(ROOT / "recon").rglob("*.py"), *(ROOT / "recon").rglob("*.j2")]
    named = {page for file in files for page in re.findall(r"docs/[\w/-]+\.md", file.read_text())}
    assert [page for page in sorted(named) if not (ROOT / page).exists()] == []


def test_the_page_of_the_command_line_names_each_command():
    app = typer.main.get_command(cli.app)
    named = set(re.findall(r"`recon ([a-z]+)", (ROOT / "docs" / "cli.md").read_text()))
    assert named >= {name for name, command in app.commands.items() if not command.hidden}
