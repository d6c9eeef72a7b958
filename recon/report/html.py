"""A report as one self-contained HTML file with pictures, 3-D views and style."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from itertools import count
from typing import Any, Final

from PIL import Image
from plotly.offline import get_plotlyjs

# The browser itself blocks anything that is not in the file. plotly.js compiles shader helpers at
# run time, hence 'unsafe-eval'; there is no foreign text that could become code.
_POLICY: Final = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' 'unsafe-eval'"
)
_WEBP_QUALITY: Final = 80
# plotly.js is embedded compressed: a third of its size, and no URL of it appears in the file.
_DRAW_SCENES: Final = """
const views = document.querySelectorAll(".view");

async function loadPlotly() {
  const packed = document.getElementById("plotly").textContent;
  const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const code = document.createElement("script");
  code.textContent = await new Response(stream).text();
  document.head.append(code);
}

async function drawView(view) {
  const element = view.querySelector(".scene");
  const scene = JSON.parse(view.querySelector("script").textContent);
  const buttons = view.querySelectorAll("button");
  element.textContent = "";
  await Plotly.newPlot(element, scene.data, scene.layout, scene.config);
  buttons.forEach((button, chosen) => button.addEventListener("click", () => {
    const [cloud, ...others] = scene.data;
    const marker = { ...cloud.marker, ...scene.colourings[chosen].marker };
    // What a click in the legend has hidden or shown stays so.
    const data = [{ ...cloud, marker }, ...others].map(
      (trace, n) => ({ ...trace, visible: element.data[n].visible })
    );
    Plotly.react(element, data, element.layout, scene.config);
    buttons.forEach((other) => other.setAttribute("aria-pressed", other === button));
  }));
}

loadPlotly().then(() => Promise.all([...views].map(drawView))).catch((error) => {
  for (const view of views) view.textContent = "No view in 3-D here: " + error;
});
"""


@dataclass(frozen=True)
class FigureBlock:
    """A figure.

    Attributes:
        title: What it shows.
        png: Bytes of a PNG file.
        caption: How to read it.
        wide: Whether it needs the whole width of the page.
    """

    title: str
    png: bytes
    caption: str = ""
    wide: bool = True


@dataclass(frozen=True)
class TableBlock:
    """A table; ``header`` may be empty."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    wide: bool = False


@dataclass(frozen=True)
class TextBlock:
    """A paragraph."""

    title: str
    text: str
    wide: bool = True


@dataclass(frozen=True)
class SceneBlock:
    """A 3-D view.

    Attributes:
        title: What it shows.
        scene: ``data``, ``layout``, ``config`` and ``colourings``, see `plot_scene`.
        caption: How to read it.
    """

    title: str
    scene: Mapping[str, Any]
    caption: str = ""


Block = FigureBlock | TableBlock | TextBlock | SceneBlock


@dataclass(frozen=True)
class Section:
    """A heading with its content."""

    title: str
    blocks: Sequence[Block]
    intro: str = ""


@dataclass(frozen=True)
class ReportContent:
    """The content of a report.

    Attributes:
        title: Heading and window title.
        subtitle: One line below it: source, size, time.
        command: The command of the run, or "".
        warnings: Warnings, shown before the figures.
        verdict: Heading of the warnings, such as "Verdict: usable"; "" counts them.
        sound: Whether the warnings are shown in green, as remarks on a good result.
        figures: The key figures, as (label, value).
        sections: The body.
        config: The effective configuration, shown collapsed.
        versions: Versions of the software used, shown collapsed.
    """

    title: str
    subtitle: str = ""
    command: str = ""
    warnings: Sequence[str] = ()
    verdict: str = ""
    sound: bool = False
    figures: Sequence[tuple[str, str]] = ()
    sections: Sequence[Section] = ()
    config: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)


def render_html(content: ReportContent) -> str:
    """Render a report as one HTML document without any external resource.

    All text is escaped. plotly.js is included once, and only if there is a 3-D view.
    """
    sections = [section for section in content.sections if section.blocks]
    scene_numbers = count()
    body = [
        _header(content, sections),
        "<main>",
        _warnings(content),
        _figures(content.figures),
        *(_section(number, section, scene_numbers) for number, section in enumerate(sections)),
        _details(content),
        "</main><footer></footer>",
    ]
    has_scene = any(
        isinstance(block, SceneBlock) for section in sections for block in section.blocks
    )
    if has_scene:
        body += [_packed_plotly(), f"<script>{_DRAW_SCENES}</script>"]
    return _document(content.title, "\n".join(part for part in body if part))


def _document(title: str, body: str) -> str:
    style = files("recon.report").joinpath("report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _packed_plotly() -> str:
    packed = base64.b64encode(gzip.compress(get_plotlyjs().encode("utf-8"), mtime=0)).decode(
        "ascii"
    )
    return f'<script type="text/plain" id="plotly">{packed}</script>'


def _header(content: ReportContent, sections: Sequence[Section]) -> str:
    links = "".join(
        f'<a href="#section-{number}">{escape(section.title)}</a>'
        for number, section in enumerate(sections)
    )
    subtitle = f'<p class="subtitle">{escape(content.subtitle)}</p>' if content.subtitle else ""
    command = f'<code class="command">{escape(content.command)}</code>' if content.command else ""
    return (
        f'<header><div class="inner"><h1>{escape(content.title)}</h1>{subtitle}{command}'
        f"<nav>{links}</nav></div></header>"
    )


def _warnings(content: ReportContent) -> str:
    count = len(content.warnings)
    counted = f"{count} warning{'s' if count > 1 else ''}" if count else "No warnings"
    heading = f"<h2>{escape(content.verdict or counted)}</h2>"
    items = "".join(f"<li>{escape(text)}</li>" for text in content.warnings)
    listed = f"<ul>{items}</ul>" if items else ""
    if content.sound or not (count or content.verdict):
        return f'<div class="notice good">{heading}{listed}</div>'
    return f'<div class="notice warn" role="alert">{heading}{listed}</div>'


def _figures(figures: Sequence[tuple[str, str]]) -> str:
    cards = "".join(
        f"<div><dt>{escape(label)}</dt><dd>{escape(value)}</dd></div>" for label, value in figures
    )
    return f'<dl class="figures">{cards}</dl>' if cards else ""


def _section(number: int, section: Section, scene_numbers: count[int]) -> str:
    intro = f'<p class="intro">{escape(section.intro)}</p>' if section.intro else ""
    blocks = "\n".join(_block(block, scene_numbers) for block in section.blocks)
    return (
        f'<section id="section-{number}"><h2>{escape(section.title)}</h2>{intro}'
        f'<div class="blocks">{blocks}</div></section>'
    )


def _smaller(png: bytes) -> tuple[str, bytes]:
    """A picture as WebP if that is smaller (a quarter of the size for noisy ones), else as PNG."""
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(png)) as picture:
        picture.convert("RGB").save(buffer, "WEBP", quality=_WEBP_QUALITY)
    webp = buffer.getvalue()
    return ("webp", webp) if len(webp) < len(png) else ("png", png)


def _block(block: Block, scene_numbers: count[int]) -> str:
    if isinstance(block, FigureBlock):
        return _framed(block.title, block.caption, _picture(block), wide=block.wide)
    if isinstance(block, TableBlock):
        return _framed(block.title, block.caption, _table(block), wide=block.wide)
    if isinstance(block, SceneBlock):
        inside = _scene(block, f"scene-{next(scene_numbers)}")
        return _framed(block.title, block.caption, inside, wide=True)
    return _framed(block.title, "", f"<p>{escape(block.text)}</p>", wide=block.wide)


def _framed(title: str, caption: str, inside: str, *, wide: bool) -> str:
    note = f'<p class="caption">{escape(caption)}</p>' if caption else ""
    kind = "block wide" if wide else "block"
    return f'<figure class="{kind}"><h3>{escape(title)}</h3>{note}{inside}</figure>'


def _picture(block: FigureBlock) -> str:
    kind, small = _smaller(block.png)
    data = base64.b64encode(small).decode("ascii")
    image = f'<img alt="{escape(block.title)}" src="data:image/{kind};base64,{data}">'
    return f'<div class="scroll">{image}</div>'


def _table(block: TableBlock) -> str:
    titles = "".join(f'<th scope="col">{_breakable(title)}</th>' for title in block.header)
    head = f"<thead><tr>{titles}</tr></thead>" if titles else ""
    rows = "".join(f"<tr>{_row(row)}</tr>" for row in block.rows)
    return f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div>'


def _row(cells: Sequence[str]) -> str:
    first = "".join(f'<th scope="row">{_breakable(cell)}</th>' for cell in cells[:1])
    return first + "".join(f"<td>{escape(cell)}</td>" for cell in cells[1:])


def _breakable(name: str) -> str:
    """The name of a figure, with line breaks allowed only between its words."""
    return re.sub(r"([._])(?=[a-z])", r"\1<wbr>", escape(name))


def _scene(block: SceneBlock, name: str) -> str:
    # "<" is escaped, so that no text can end the script element.
    data = json.dumps(block.scene, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<div class="view">{_colouring_buttons(block.scene)}'
        '<div class="scene">The view in 3-D needs JavaScript.</div>'
        f'<script type="application/json" id="{name}">{data}</script></div>'
    )


def _colouring_buttons(scene: Mapping[str, Any]) -> str:
    labels = [colouring["label"] for colouring in scene.get("colourings", ())]
    if len(labels) < 2:
        return ""
    buttons = "".join(
        f'<button type="button" aria-pressed="{str(n == 0).lower()}">{escape(label)}</button>'
        for n, label in enumerate(labels)
    )
    return f'<div class="choices">Colour: {buttons}</div>'


def _details(content: ReportContent) -> str:
    versions = [(name, version) for name, version in content.versions.items()]
    parts = []
    if content.config:
        parts.append(_folded("Configuration", f"<pre>{escape(content.config)}</pre>"))
    if versions:
        parts.append(_folded("Versions", _table(TableBlock("", (), versions))))
    if not parts:
        return ""
    return "<section><h2>How it was made</h2>" + "".join(parts) + "</section>"


def _folded(title: str, inside: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{inside}</details>"
