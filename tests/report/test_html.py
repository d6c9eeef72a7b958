from __future__ import annotations

import base64
import gzip
import io
import re
from html.parser import HTMLParser

import numpy as np
from PIL import Image
from plotly.offline import get_plotlyjs

from recon.core.values import PointCloud
from recon.report.html import (
    FigureBlock,
    ReportContent,
    SceneBlock,
    Section,
    TableBlock,
    TextBlock,
    render_html,
)
from recon.report.scene3d import Scene, plot_scene

LOADING = {"src", "href", "data", "action", "poster", "srcset", "xlink:href"}
NASTY = "<script>alert('x')</script> & \"quoted\""


class Loads(HTMLParser):
    """Collects what a page would load, its text, and the elements that stay open."""

    VOID = frozenset({"meta", "img", "br", "wbr", "link", "input"})

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


def png(picture: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "PNG")
    return buffer.getvalue()


def embedded(picture: np.ndarray) -> tuple[str, np.ndarray]:
    """Kind and pixels of a picture in a page."""
    block = FigureBlock("a", png(picture))
    page = render_html(ReportContent("t", sections=(Section("s", (block,)),)))
    (kind, data), *_ = re.findall(r'src="data:image/(\w+);base64,([^"]+)"', page)
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        return kind, np.asarray(image.convert("RGB"))


def test_a_picture_is_packed_where_that_makes_it_smaller() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    kind, pixels = embedded(noise)
    assert (kind, pixels.shape) == ("webp", noise.shape)
    kind, pixels = embedded(np.zeros((1, 1, 3), np.uint8))
    np.testing.assert_array_equal(pixels, 0)
    assert kind in {"png", "webp"}


def scene() -> SceneBlock:
    cloud = PointCloud(np.eye(3, dtype=np.float32))
    return SceneBlock("In 3-D", plot_scene(Scene(np.eye(4), cloud)))


def full_report(text: str = "plain") -> ReportContent:
    section = Section(
        f"Section {text}",
        (
            FigureBlock(f"Figure {text}", png(np.zeros((2, 2, 3), np.uint8)), f"Caption {text}"),
            TableBlock(f"Table {text}", (text,), ((text, text),)),
            TextBlock(f"Text {text}", text),
            scene(),
        ),
        intro=text,
    )
    return ReportContent(
        title=f"Title {text}",
        subtitle=text,
        command=f"recon {text}",
        warnings=(f"Warning {text}",),
        figures=((f"Label {text}", f"Value {text}"),),
        sections=(section,),
        config=f"key: {text}",
        versions={"recon": text},
    )


def test_report_loads_nothing_from_outside() -> None:
    page = render_html(full_report())
    assert all(target.startswith(("data:", "#")) for target in parse(page).loads)
    assert "link" not in parse(page).tags
    assert not re.search(r"@import|url\(", page)
    assert not re.search(r"https?://", page)


def test_browser_is_told_to_refuse_what_is_outside() -> None:
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', render_html(full_report()))
    assert policy is not None
    assert "default-src 'none'" in policy[1]
    assert "http" not in policy[1]


def test_report_has_every_part() -> None:
    text = parse(render_html(full_report("this"))).text
    parts = ("Section", "Figure", "Caption", "Table", "Text", "Title", "Warning", "Label", "Value")
    for part in parts:
        assert f"{part} this" in text
    assert "recon this" in text
    assert "key: this" in text


def test_all_text_is_escaped_and_every_element_closed() -> None:
    page = parse(render_html(full_report(NASTY)))
    plain = parse(render_html(full_report()))
    assert page.open == []
    assert page.tags == plain.tags
    assert page.text.count(NASTY) >= 12


def test_warnings_come_before_all_figures() -> None:
    page = render_html(full_report())
    assert 0 < page.index("Warning plain") < page.index("Label plain") < page.index("Figure plain")
    assert "No warnings" in render_html(ReportContent("empty"))


def test_text_in_a_scene_cannot_end_its_script() -> None:
    block = SceneBlock("s", {"data": [{"name": "</script><b>"}], "layout": {}, "config": {}})
    page = render_html(ReportContent("t", sections=(Section("s", (block,)),)))
    assert "</script><b>" not in page
    assert parse(page).open == []


def test_plotly_travels_once_compressed_and_only_with_a_scene() -> None:
    two = ReportContent("t", sections=(Section("a", (scene(),)), Section("b", (scene(),))))
    page = render_html(two)
    packed = re.findall(r'<script type="text/plain" id="plotly">([^<]*)</script>', page)
    assert len(packed) == 1
    assert gzip.decompress(base64.b64decode(packed[0])).decode() == get_plotlyjs()
    assert {'id="scene-0"', 'id="scene-1"'} <= set(re.findall(r'id="scene-\d"', page))
    without = render_html(ReportContent("t", sections=(Section("a", (TextBlock("b", "c"),)),)))
    assert "plotly" not in without
    assert len(without) < 20_000


def test_colourings_of_a_scene_get_a_button_each_where_there_is_a_choice() -> None:
    coloured = PointCloud(np.eye(3, dtype=np.float32), rgb=np.eye(3, dtype=np.uint8))
    block = SceneBlock("In 3-D", plot_scene(Scene(np.eye(4), coloured)))
    page = render_html(ReportContent("t", sections=(Section("a", (block,)),)))
    assert re.findall(r"<button[^>]*>(\w+)</button>", page) == ["picture", "height"]
    plain = render_html(ReportContent("t", sections=(Section("a", (scene(),)),)))
    assert "</button>" not in plain


def test_sections_without_content_are_left_out() -> None:
    page = render_html(ReportContent("t", sections=(Section("Nothing here", ()),)))
    assert "Nothing here" not in page


def test_same_content_gives_the_same_page() -> None:
    assert render_html(full_report()) == render_html(full_report())


def test_a_long_name_in_a_table_is_broken_between_its_words_alone() -> None:
    table = TableBlock("t", ("figure",), (("trajectory.ate_max_m", "0.05"),))
    page = render_html(ReportContent("t", sections=(Section("s", (table,)),)))
    assert "trajectory.<wbr>ate_<wbr>max_<wbr>m</th><td>0.05</td>" in page
