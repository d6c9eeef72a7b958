"""A page is one file that loads nothing, and shows text as text."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from jinja2 import UndefinedError
from PIL import Image
from plotly.offline import get_plotlyjs

from recon.core.values import PointCloud
from recon.report.page import (
    command_line,
    page_environment,
    render_page,
    summary_rows,
    write_page,
)
from recon.report.scene import Scene, plot_scene
from recon.run.directory import RunDirectory
from tests.report.pages import parse

NASTY = "<script>alert('x')</script> & \"quoted\" {{ 1 + 1 }} {% raw %}"


def png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def black() -> bytes:
    return png(np.zeros((2, 2, 3), np.uint8))


def view(coloured: bool = False) -> dict[str, Any] | None:
    rgb = np.eye(3, dtype=np.uint8) if coloured else None
    return plot_scene(Scene(np.eye(4), PointCloud(np.eye(3, dtype=np.float32), rgb=rgb)))


def audit_page(text: str = "plain", **changes: Any) -> str:
    """A page with a text in every place that can be foreign."""
    pair = {"index": 3, "images": black(), "rows": None, "disparity": black(), "wide": True}
    content = {
        "source": SimpleNamespace(name=f"Source {text}", description=f"Description {text}"),
        "lines": {"frames": f"Frames {text}", f"Check {text}": f"Cell {text}"},
        "found": {"baseline_m": 0.5, "row_error_rms_px": None, "depth_error_m": None},
        "frames": None,
        "pairs": [{**pair, "valid_percent": 75.0}],
        "warnings": [f"Warning {text}"],
        "verdict": f"Word {text}",
        "command": f"recon {text}",
        "config": f"key: {text}",
        "versions": {f"Package {text}": f"Version {text}"},
    }
    return render_page("audit", **{**content, **changes})


def scene_page(plot: dict[str, Any] | None, times: int = 1) -> str:
    """A page with the same view several times."""
    calls = "{{ scene('In 3-D', plot, 'caption') }}" * times
    template = (
        '{% extends "page.html.j2" %}{% from "parts.html.j2" import scene, section %}'
        "{% block body %}{% call section('S') %}" + calls + "{% endcall %}{% endblock %}"
    )
    return page_environment().from_string(template).render(plot=plot)


def embedded(image: np.ndarray) -> tuple[str, np.ndarray]:
    """Kind and pixels of an image in a page."""
    page = audit_page(frames=png(image))
    (kind, data), *_ = re.findall(r'src="data:image/(\w+);base64,([^"]+)"', page)
    with Image.open(io.BytesIO(base64.b64decode(data))) as found:
        return kind, np.asarray(found.convert("RGB"))


def test_an_image_is_packed_where_that_makes_it_smaller() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    kind, pixels = embedded(noise)
    assert (kind, pixels.shape) == ("webp", noise.shape)
    kind, pixels = embedded(np.zeros((1, 1, 3), np.uint8))
    np.testing.assert_array_equal(pixels, 0)
    assert kind in {"png", "webp"}


def test_report_loads_nothing_from_outside_and_the_browser_would_refuse_it() -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', audit_page())
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    for page in (audit_page(), scene_page(view())):
        assert all(target.startswith(("data:", "#")) for target in parse(page).loads)
        assert "link" not in parse(page).tags
        assert not re.search(r"@import|url\(", page)
        assert not re.search(r"https?://", page)


def test_all_text_is_escaped_and_every_element_closed() -> None:
    page, plain = parse(audit_page(NASTY)), parse(audit_page())
    assert page.open == []
    assert page.tags == plain.tags
    parts = ("Source", "Description", "Frames", "Check", "Cell", "Warning", "Word", "Package")
    for part in (*parts, "Version", "recon", "key:"):
        assert f"{part} {NASTY}" in page.text
        assert f"{part} plain" in plain.text


def test_warnings_come_before_all_figures() -> None:
    page = audit_page()
    assert 0 < page.index("Warning plain") < page.index("<dt>Baseline") < page.index("<img")
    assert "No warnings" in audit_page(warnings=(), verdict="")
    assert "2 warnings" in audit_page(warnings=("a", "b"), verdict="")


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        ({"warnings": (), "verdict": ""}, "good"),
        ({"warnings": ("w",), "verdict": ""}, "warn"),
        ({"warnings": ("w",), "verdict": "usable"}, "warn"),
        ({"warnings": ("w",), "verdict": "good", "sound": True}, "good"),
    ],
)
def test_only_what_is_wrong_is_alarming(content: dict[str, Any], kind: str) -> None:
    page = audit_page(**content)
    assert f'class="notice {kind}"' in page
    assert ('role="alert"' in page) == (kind == "warn")


def test_text_in_a_scene_cannot_end_its_script() -> None:
    plot = {"data": [{"name": "</script><b>"}], "layout": {}}
    page = scene_page(plot)
    assert "</script><b>" not in page
    assert parse(page).open == []
    (packed,) = re.findall(r'<script type="application/json">(.*?)</script>', page)
    assert json.loads(packed) == plot


def test_plotly_travels_once_compressed_and_only_with_a_scene() -> None:
    page = scene_page(view(), times=2)
    assert page.count('<div class="scene">') == 2
    packed = re.findall(r'<script type="text/plain" id="plotly">([^<]*)</script>', page)
    assert len(packed) == 1
    assert gzip.decompress(base64.b64decode(packed[0])).decode() == get_plotlyjs()
    without = audit_page()
    assert 'id="plotly"' not in without
    assert len(without) < 20_000


def test_colourings_of_a_scene_get_a_button_each_where_there_is_a_choice() -> None:
    page = scene_page(view(coloured=True))
    assert re.findall(r"<button[^>]*>(\w+)</button>", page) == ["image", "height"]
    assert "</button>" not in scene_page(view())
    # A scene of nothing is left out, and with it its section.
    assert not re.search("In 3-D|#section-", scene_page(None))


def test_contents_name_the_sections_that_there_are() -> None:
    page, sections = audit_page(), [("1", "Measured"), ("2", "Pair 3")]
    assert re.findall(r'<a href="#section-(\d)">([^<]+)</a>', page) == sections
    assert re.findall(r'<section id="section-(\d)">\s*<h2>([^<]+)', page) == sections
    assert page == audit_page()


def test_a_page_without_its_content_is_an_error() -> None:
    with pytest.raises(UndefinedError):
        render_page("audit")


def test_a_long_name_in_a_table_is_broken_between_its_words_alone() -> None:
    page = audit_page(lines={"frames": "1", "trajectory.ate_max_m": "0.05"})
    assert "trajectory.<wbr>ate_<wbr>max_<wbr>m</th><td>0.05</td>" in page


def test_figures_of_each_part_are_rows_of_their_own() -> None:
    found: dict[str, Any] = {"by_length": [{"length_m": 50.0, "segments": 15}]}
    found |= {"views_dropped": [], "stages": {"match": 1.0}, "nested": {"a": [1, None]}}
    assert summary_rows(found) == [
        ("by_length.0.length_m", "50 m"),
        ("by_length.0.segments", "15"),
        ("views_dropped", "none"),
        ("nested.a", "1, –"),
    ]


def test_page_of_a_run_shows_its_configuration(tmp_path: Path) -> None:
    content = {"source": SimpleNamespace(name="s", description="d"), "lines": {"frames": "1"}}
    with RunDirectory(tmp_path / "run") as directory:
        directory.path("config.yaml").write_text("rectification: <b>\n")
        found = {"baseline_m": 0.5, "row_error_rms_px": None, "depth_error_m": None}
        write_page("audit", directory, found, **content, frames=None, pairs=[])
        directory.write_json("run.json", {})
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "<pre>rectification: &lt;b&gt;\n</pre>" in page


@pytest.mark.parametrize(
    ("program", "line"),
    [
        ("bin/recon", "recon map 'a b'"),
        ("site-packages/recon/__main__.py", "recon map 'a b'"),
        ("other.py", ""),
    ],
)
def test_report_names_the_command_that_made_it_and_no_other_program(
    program: str, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [program, "map", "a b"])
    assert command_line() == line
