"""A page of a report as one self-contained HTML file, and what all pages share."""

from __future__ import annotations

import base64
import functools
import gzip
import io
import json
import re
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import PIL.Image
import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from plotly.offline import get_plotlyjs

from recon.core.machine import versions
from recon.core.summary import to_json
from recon.core.text import counted
from recon.io.atomic import write_text
from recon.report import style
from recon.report.scene import Scene
from recon.report.sections import Page, Section, Table, Text, View3D, is_number, known
from recon.report.view3d import draw_still, plot, view_of
from recon.run.directory import RunDirectory

_WEBP_QUALITY: Final = 80
_WEBP_METHOD: Final = 2  # in less than half of the time of the usual 4, a twentieth larger
_WEBP_MOST_PX: Final = 16_383  # a side of a picture, by its format
_SAID_ELSEWHERE: Final = frozenset({"stages", "warnings", "findings"})


def write_page(page: Page, run: RunDirectory, name: str = "report.html") -> None:
    """Write the report of a run, or another page."""
    path = run.path("config.yaml")
    config = path.read_text(encoding="utf-8") if path.is_file() else ""
    write_text(run.path(name), render_page(page, command_line(), config, versions()))


def render_page(
    page: Page, command: str = "", config: str = "", versions: Mapping[str, str] | None = None
) -> str:
    """Render a page as one HTML document without any external resource; all text is escaped."""
    verdict = page.found.get("verdict", "")
    warnings = page.found.get("warnings", ()) if page.warnings is None else page.warnings
    counts = counted(len(warnings), "warning") if warnings else "No warnings"
    packages = "\n".join(f"{name} {version}" for name, version in (versions or {}).items())
    made = [Text("Configuration", config), Text("Versions", packages)]
    kept = [one for one in (*page.sections, Section("How it was made", made)) if one.shown]
    in_3d = any(isinstance(block, View3D) for section in kept for block in section.shown)
    return _template().render(
        page=page,
        sections=kept,
        warnings=warnings,
        notice=f"Verdict: {verdict}" if verdict else counts,
        # Of what is good, warnings are remarks.
        alarming=verdict != "good" and bool(warnings or verdict),
        command=command,
        plotly=_packed_plotly() if in_3d else "",
    )


@functools.cache
def _template() -> Template:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        embedded=embedded,
        drawn=_drawn,
        # A line may break between the words of the name of a figure.
        words=re.compile(r"(?<=[._])(?=[a-z])").split,
    )
    return environment.get_template("page.html.j2")


def _drawn(block: View3D) -> dict[str, Any]:
    view = view_of(block.scene or Scene(), block.max_points)
    return {"plot": plot(view), "still": draw_still(view)}


def run_figures(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what a run took."""
    return [
        ("Run time", known("{:.1f} s", found.get("seconds"))),
        ("Peak memory", known("{:,.0f} MB", found.get("peak_memory_mb"))),
    ]


def run_section(found: Mapping[str, Any]) -> Section:
    """Return the time of each stage, and every figure of a summary."""
    stages = {name: s for name, s in (found.get("stages") or {}).items() if is_number(s)}
    total = max(sum(stages.values()), 1e-12)
    rows = [(name, f"{s:.2f} s", f"{100 * s / total:.0f} %") for name, s in stages.items()]
    note = "Wall-clock time of each stage. Stages that run in parallel are all counted."
    rest = {key: value for key, value in found.items() if key not in _SAID_ELSEWHERE}
    plainly = json.loads(json.dumps(to_json(rest)))  # numpy's numbers, too
    figures = yaml.safe_dump(plainly, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return Section("Run", [
        Table("Time by stage", ("stage", "time", "of all"), rows, caption=note),
        Text("All figures", figures if rest else ""),
    ])  # fmt: skip


def last_part(name: str) -> str:
    """Return the name of a file or folder without where it is."""
    return Path(name).name or name


def command_line() -> str:
    """Return the command line of this process, or "" if it is not one of recon."""
    program = Path(sys.argv[0] if sys.argv else "")
    module = program.parts[-2:] == ("recon", "__main__.py")
    ours = module or program.name in {"recon", "recon.exe"}
    return shlex.join(["recon", *sys.argv[1:]]) if ours else ""


@functools.cache
def _packed_plotly() -> str:
    """Return plotly.js, compressed: a third of its size, and no URL of it appears in the file."""
    return base64.b64encode(gzip.compress(get_plotlyjs().encode("utf-8"), mtime=0)).decode("ascii")


def embedded(png: bytes) -> dict[str, Any]:
    """Return what is seen in an image, and kinds and URLs of its layers, one upon the other.

    Of a figure that is ``ink``, which a dark page makes light, and its ``picture``, if it has one.
    """
    with PIL.Image.open(io.BytesIO(png)) as image:
        layers, boxes = {"picture": image}, json.loads(image.info.get(style.PICTURES, "null"))
        if boxes is not None:
            mask = PIL.Image.new("L", image.size)
            for box in boxes:
                mask.paste(255, tuple(box))
            layers["picture"].putalpha(mask)
            ink = PIL.Image.composite(
                PIL.Image.new("RGB", image.size, "white"), image.convert("RGB"), mask
            )
            layers = {"ink": ink} | (layers if boxes else {})
        shown = [(kind, _url(one)) for kind, one in layers.items()]
        return {"seen": image.info.get(style.SEEN, ""), "layers": shown}


def _url(image: PIL.Image.Image) -> str:
    buffer = io.BytesIO()
    if max(image.size) > _WEBP_MOST_PX:
        image = image.copy()
        image.thumbnail((_WEBP_MOST_PX, _WEBP_MOST_PX))
    image.save(buffer, "WEBP", quality=_WEBP_QUALITY, method=_WEBP_METHOD)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
