"""The fenced blocks of the project's pages."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
TOP = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
PAGES = sorted(
    [*(ROOT / name for name in TOP), *(ROOT / "docs").rglob("*.md")],
    key=lambda path: path.as_posix(),
)

_FENCE = re.compile(r"^( *)```(\S*)[^\n]*\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
_ENDS_OF_COMMANDS = {"&&", "||", ";", "|", "&"}


@dataclass(frozen=True)
class Block:
    page: str  # path of the page, from the root of the project
    line: int  # line of its opening fence, from 1
    language: str  # what follows the fence
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks_of(page: Path) -> list[Block]:
    text, name = page.read_text(), page.relative_to(ROOT).as_posix()
    return [
        Block(name, 1 + text.count("\n", 0, found.start()), found[2], found[3])
        for found in _FENCE.finditer(text)
    ]


def commands_in(script: str) -> Iterator[list[str]]:
    """The words of each command of a shell script; comments, pipes and redirections apart."""
    for line in script.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        words: list[str] = []
        redirected = False
        for word in [*lexer, ";"]:
            if word in _ENDS_OF_COMMANDS:
                if words:
                    yield words
                words, redirected = [], False
            elif word == ">" or redirected:
                redirected = True
            else:
                words.append(word)
