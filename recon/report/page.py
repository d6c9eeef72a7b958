"""A report as one self-contained HTML file: fills the template of a page."""

from __future__ import annotations

import base64
import functools
import gzip
import io
import json
import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image
from plotly.offline import get_plotlyjs

from recon.core.machine import versions
from recon.core.text import counted, metres, with_unit
from recon.io.atomic import write_text
from recon.report import style
from recon.report.still import draw_still
from recon.report.table import NOT_KNOWN
from recon.run.directory import RunDirectory

_WEBP_QUALITY: Final = 80
_WEBP_METHOD: Final = 2  # in less than half of the time of the usual 4, a twentieth larger
_WEBP_MOST_PX: Final = 16_383  # a side of a picture, by its format
_NOT_TABULATED: Final = frozenset({"stages", "warnings", "findings"})


def write_page(name: str, run: RunDirectory, found: Mapping[str, Any], /, **content: Any) -> None:
    """Write ``report.html`` of a run; ``content`` overrides warnings and verdict of its summary."""
    path, verdict = run.path("config.yaml"), found.get("verdict", "")
    page = {
        "found": found,
        "warnings": found.get("warnings", ()),
        "verdict": verdict,
        "sound": verdict == "good",
        "command": command_line(),
        "config": path.read_text(encoding="utf-8") if path.is_file() else "",
        "versions": versions(),
    }
    write_text(run.path("report.html"), render_page(name, **{**page, **content}))


def render_page(name: str, **content: Any) -> str:
    """Render a page as one HTML document without any external resource; all text is escaped.

    All templates know ``warnings``, ``verdict`` (heading of the warnings; "" counts them),
    ``sound`` (they are remarks on a good result, in green), ``command``, ``config``, ``versions``.
    """
    return page_environment().get_template(f"{name}.html.j2").render(content)


def page_environment() -> Environment:
    """Make Jinja with our templates and filters, for one page."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        extensions=["jinja2.ext.do"],
    )
    environment.tests["finite"] = _is_number
    environment.filters.update(
        counted=counted, embedded=_embedded, leaves=summary_rows, timing=_timing,
        known=lambda value, form: NOT_KNOWN if value is None else form % value,
        last_part=lambda name: Path(name).name or name, shortest="{:.3g}".format, still=draw_still,
        # A line may break between the words of the name of a figure.
        words=re.compile(r"(?<=[._])(?=[a-z])").split,
    )  # fmt: skip
    # Sections add their titles to the contents.
    environment.globals.update(
        warnings=(), verdict="", sound=False, command="", config="", versions={}, contents=[],
        plotly=_packed_plotly, metres=metres,
    )  # fmt: skip
    return environment


def command_line() -> str:
    """Return the command line of this process, or "" if it is not one of recon."""
    program = Path(sys.argv[0] if sys.argv else "")
    module = program.parts[-2:] == ("recon", "__main__.py")
    ours = module or program.name in {"recon", "recon.exe"}
    return shlex.join(["recon", *sys.argv[1:]]) if ours else ""


def summary_rows(summary: Mapping[Any, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return names and texts of a nested mapping, one row per leaf."""
    rows: list[tuple[str, str]] = []
    for key, value in summary.items():
        if not prefix and key in _NOT_TABULATED:
            continue
        if isinstance(value, Mapping):
            rows += summary_rows(value, f"{prefix}{key}.")
        elif isinstance(value, Sequence) and any(isinstance(item, Mapping) for item in value):
            rows += summary_rows(dict(enumerate(value)), f"{prefix}{key}.")
        else:
            name, text = f"{prefix}{key}", _text(value)
            unitless = value is None or isinstance(value, str | bool) or value == []
            rows.append((name, text if unitless else with_unit(text, name)))
    return rows


def _text(value: Any) -> str:
    if value is None:
        return NOT_KNOWN
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(_text(item) for item in value) or "none"
    return str(value)


def _timing(summary: Mapping[str, Any]) -> bytes:
    stages = {name: s for name, s in (summary.get("stages") or {}).items() if _is_number(s)}
    return timing_figure(stages) if stages else b""  # no stage was measured


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@functools.cache
def _packed_plotly() -> str:
    """Return plotly.js, compressed: a third of its size, and no URL of it appears in the file."""
    return base64.b64encode(gzip.compress(get_plotlyjs().encode("utf-8"), mtime=0)).decode("ascii")


def _embedded(png: bytes) -> dict[str, Any]:
    """Return what is seen in an image, and kinds and URLs of its layers, one upon the other.

    Of a figure that is ``ink``, which a dark page makes light, and its ``picture``, if it has one.
    """
    with Image.open(io.BytesIO(png)) as image:
        layers, boxes = {"picture": image}, json.loads(image.info.get(style.PICTURES, "null"))
        if boxes is not None:
            mask = Image.new("L", image.size)
            for box in boxes:
                mask.paste(255, tuple(box))
            layers["picture"].putalpha(mask)
            ink = Image.composite(Image.new("RGB", image.size, "white"), image.convert("RGB"), mask)
            layers = {"ink": ink} | (layers if boxes else {})
        shown = [(kind, _url(one)) for kind, one in layers.items()]
        return {"seen": image.info.get(style.SEEN, ""), "layers": shown}


def _url(image: Image.Image) -> str:
    buffer = io.BytesIO()
    if max(image.size) > _WEBP_MOST_PX:
        image = image.copy()
        image.thumbnail((_WEBP_MOST_PX, _WEBP_MOST_PX))
    image.save(buffer, "WEBP", quality=_WEBP_QUALITY, method=_WEBP_METHOD)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


@style.styled
def timing_figure(stages: Mapping[str, float]) -> bytes:
    """Draw time and fraction of each stage, in the order of the mapping."""
    figure, axes = style.subplots(style.HALF_IN, max(1.6, 0.42 * len(stages) + 0.9))
    seconds = np.asarray(list(stages.values()), dtype=np.float64)
    total = max(float(seconds.sum()), 1e-12)
    bars = axes.barh(list(stages), seconds, height=0.62)
    axes.bar_label(bars, [f"{value:.2f} s · {value / total:.0%}" for value in seconds], padding=4)
    axes.invert_yaxis()
    axes.set(xlabel="time (s)", xlim=(0, max(float(seconds.max(initial=0.0)), 1e-12) * 1.28))
    axes.grid(visible=False, axis="y")
    longest = sorted(stages.items(), key=lambda stage: -stage[1])[:3]
    named = ", ".join(f"{name} {spent:.2f} s" for name, spent in longest)
    return style.to_png(figure, f"Of {total:.2f} s, most in {named}" if named else "")
