"""What makes a site of pages that are written to be read in a repository, too (mkdocs.yml)."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
#: Pages of the top folder, by their names in the site.
TOP = {"README.md": "index.md"} | {
    name: name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
}
_FENCE = re.compile(r"(^ *```.*?^ *```$)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[([^\]]*)\]\(((?!https?:|mailto:|#)[^)\s]+)\)")
_BEGINS_BLOCK = re.compile(r"^(?!\||[ ]*[-*] |[ ]*\d+\. |#)(\S.*)\n(?=\||- |\d+\. )", re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    for name, here in TOP.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, here, content=_from_top(text)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Give lists and tables the empty line before them that Python-Markdown asks for."""
    markdown = _outside_of_code(_BEGINS_BLOCK, r"\1\n\n", markdown)
    if page.file.src_uri not in TOP.values():
        markdown = _outside_of_code(_LINK, _within_site, markdown)
    return markdown


def _within_site(link: re.Match[str]) -> str:
    """Lead to a page of the top folder; of files that the site has not, keep the words."""
    text, target = link.groups()
    above = re.match(r"(?:\.\./)+([A-Z][\w.-]+)(#.*)?$", target)
    if above and above[1] in TOP:
        return f"[{text}]({target.replace('README.md', 'index.md').replace('../', '', 1)})"
    outside = target.startswith("../") and not re.match(r"\.\./[\w-]+\.md|\.\./images/", target)
    return text if outside else link[0]


def _from_top(text: str) -> str:
    def moved(link: re.Match[str]) -> str:
        words, target = link.groups()
        name = target.partition("#")[0]
        if target.startswith("docs/"):
            return f"[{words}]({target.removeprefix('docs/')})"
        return f"[{words}]({target.replace('README.md', 'index.md')})" if name in TOP else words

    return _outside_of_code(_LINK, moved, text)


def _outside_of_code(pattern: re.Pattern[str], change: Any, text: str) -> str:
    parts = _FENCE.split(text)
    return "".join(part if n % 2 else pattern.sub(change, part) for n, part in enumerate(parts))
