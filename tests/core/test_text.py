"""Numbers in text from outside are ASCII decimals, for every reader and option."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from recon.cli.options import parse_numbers as parse_option
from recon.commands.config import load_config
from recon.core.errors import ReconError
from recon.core.text import counted, is_count, parse_integer, parse_number, unit_of, with_unit
from recon.io.cameras.opencv_yaml import read_file_storage
from recon.io.fields import parse_yaml
from recon.io.files import read_table
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_frames
from recon.run.threads import parse_size_mb
from recon.sources.times import read_dates, read_stamped_names

FOREIGN = ["1_0", "١٢", "1_0.5", "\uff11\uff12"]
PLY = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "table": (lambda path: read_table(path, (2,)), "1 {}\n"),
    "frames": (read_frames, "left.png,right.png,0.5,{}\n"),
    "stamps": (read_stamped_names, "{} image.png\n"),
    "dates": (read_dates, "2011-09-26 13:02:{}.964\n"),
    "cloud": (read_ply, PLY + "property float z\nend_header\n1 2 {}\n"),
}


@pytest.mark.parametrize("number", ["1", "-1.5", "+.5", "1e-05", "7."])
def test_decimal_numbers_are_what_python_reads(number: str) -> None:
    assert parse_number(number) == float(number)


@pytest.mark.parametrize("text", FOREIGN)
def test_other_notations_are_no_numbers(text: str) -> None:
    assert not is_count(text)
    for parse in (parse_number, parse_integer):
        with pytest.raises(ValueError, match=r"not a decimal number|invalid literal"):
            parse(text)


@pytest.mark.parametrize("text", FOREIGN)
@pytest.mark.parametrize("reader", READERS)
def test_readers_refuse_other_notations(tmp_path: Path, reader: str, text: str) -> None:
    read, content = READERS[reader]
    (tmp_path / "file").write_text(content.format(text), encoding="utf-8")
    with pytest.raises(ReconError):
        read(tmp_path / "file")


@pytest.mark.parametrize("reader", READERS)
def test_readers_take_the_same_files_with_decimals(tmp_path: Path, reader: str) -> None:
    read, content = READERS[reader]
    (tmp_path / "file").write_text(content.format("10"), encoding="utf-8")
    read(tmp_path / "file")


@pytest.mark.parametrize("text", [*FOREIGN, "0x10", "1:30"])
def test_numbers_of_old_yaml_are_text(tmp_path: Path, text: str) -> None:
    assert parse_yaml(f"value: {text}", "x.yaml") == {"value": text}
    (tmp_path / "rig.yml").write_text(f"%YAML:1.0\n---\nfx: {text}\n", encoding="utf-8")
    assert read_file_storage(tmp_path / "rig.yml") == {"fx": text}


def test_yaml_has_decimals_and_what_is_not_finite() -> None:
    text = "[10, 010, -2, 0.5, 1.5e+3, -.inf, true]"
    assert parse_yaml(text, "x.yaml") == [10, 10, -2, 0.5, 1500.0, -float("inf"), True]


@pytest.mark.parametrize("text", FOREIGN)
def test_settings_and_options_refuse_other_notations(text: str) -> None:
    for setting in (f"fusion.voxel_m={text}", f"audit.baseline_m=[0.1, {text}]"):
        with pytest.raises(ReconError, match="number"):
            load_config(None, [setting])
    with pytest.raises(ReconError, match="--antenna"):
        parse_option(f"1,{text},3", "--antenna")
    with pytest.raises(ReconError):
        parse_size_mb(f"{text}M")


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0 frames"), (1, "1 frame"), (2, "2 frames"), (-1, "-1 frame"), (1200, "1200 frames")],
)
def test_one_thing_is_no_plural(number: int, text: str) -> None:
    assert counted(number, "frame") == text


def test_a_number_may_be_written_in_another_form() -> None:
    assert counted(1, "frame", form="+d") == "+1 frame"
    assert counted(1200, "point", form=",") == "1,200 points"


def test_some_words_have_a_plural_of_their_own() -> None:
    assert [counted(n, "match", "matches") for n in (1, 2)] == ["1 match", "2 matches"]


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("path_length_m", "m"),
        ("trajectory.r_rel_deg_per_100m", "°/100 m"),
        ("trajectory.t_rel_percent at 100 m", "%"),
        ("speed_m_per_s", "m/s"),
        ("peak_memory_mb", "MB"),
        ("fps", "frames/s"),
        ("seconds", "s"),
        ("seconds.match", "s"),
        ("seconds_per_frame.p95", "s"),
        ("live.latency_ms.p50", "ms"),
        ("disparity.bad.0.5", "%"),
        ("disparity.quantiles_px.50", "px"),
        ("depth_error_cm.10.calibration", "cm"),
        ("precision at 0.2 m", ""),
        ("frames", ""),
        ("frames_not_trusted", ""),
        ("map.f_score", ""),
        ("m", ""),
    ],
)
def test_a_figure_has_the_unit_that_its_name_tells(name: str, unit: str) -> None:
    assert unit_of(name) == unit
    assert with_unit("3", name) == f"3 {unit}".strip()
