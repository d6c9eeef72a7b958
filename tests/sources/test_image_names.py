"""Names of images: which are times, which are pairs, and what a times.txt has to say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import FormatError, ReconError, SourceError
from recon.io.images.image import write_image
from recon.sources.image_names import find_partners, pair_images
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.times import pair_stamps, stamp_of_name
from tests.sources.drives import CAMERA, write_calib


@pytest.mark.parametrize(
    ("stem", "seconds"),
    [("1305031102.175304", 1305031102.175304), ("1403636579763555584", 1403636579.763555584),
     ("1600000000123", 1600000000.123), ("1600000000123456", 1600000000.123456),
     ("0.25", 0.25), ("000012", None), ("left01", None), ("1_5", None)],
)  # fmt: skip
def test_names_that_are_stamps_are_distinguished_from_counts(
    stem: str, seconds: float | None
) -> None:
    assert stamp_of_name(stem) == (seconds if seconds is None else pytest.approx(seconds, abs=1e-6))


STAMPS = st.lists(st.integers(0, 10_000), min_size=1, max_size=30, unique=True)


@given(STAMPS, STAMPS, st.integers(1, 300))
def test_pairs_by_stamp_are_near_mutual_and_in_order(
    left: list[int], right: list[int], tolerance: int
) -> None:
    ours, theirs = (np.array(sorted(s), dtype=np.float64) for s in (left, right))
    apart = np.abs(ours[:, None] - theirs[None])
    near = (apart == apart.min(0)) & (apart == apart.min(1)[:, None]) & (apart <= tolerance)
    try:
        frames = pair_stamps(ours, theirs, float(tolerance), Path("here"))
    except ReconError:
        assert 2 * near.any(1).sum() < min(near.shape) or not near.any()
        return
    pairs = [(i, j) for i, j in frames if i is not None and j is not None]
    assert all(near[pair] for pair in pairs)
    for side in (0, 1):  # each image once, in order
        found = [frame[side] for frame in frames if frame[side] is not None]
        assert found == list(range(near.shape[side]))
    times = [ours[i] if i is not None else theirs[j] for i, j in frames]
    assert times == sorted(times)


def write_named(folder: Path, names: list[str]) -> Path:
    """Pairs of equal names in two folders, the grey values counting the frames."""
    for number, name in enumerate(names):
        for side in ("left", "right"):
            write_image(folder / side / f"{name}.png", np.full((32, 64), number, np.uint8))
    write_calib(folder, CAMERA)
    return folder


def times(folder: Path, **settings: object) -> list[float]:
    source = open_source(folder, "folders", SourceSettings.model_validate(settings))
    return source.stamps_s.tolist()


@pytest.mark.parametrize("digits", [10, 13, 16, 19])
@pytest.mark.parametrize(("step", "count"), [(1, 4), (5, 4), (1, 1)])
def test_padded_counters_are_no_times(tmp_path: Path, digits: int, step: int, count: int) -> None:
    folder = write_named(tmp_path, [f"{100 + step * k:0{digits}d}" for k in range(count)])
    assert times(folder) == [0.0, 0.1, 0.2, 0.3][:count]
    assert "no times: assumed 10 Hz" in open_source(folder).description


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["1600000000", "1600000001"], [1600000000, 1600000001]),
        (["1600000000123", "1600000000156"], [1600000000.123, 1600000000.156]),
        # Nanoseconds since a simulation began.
        (["0000000000000000000", "0000000000050000000"], [0.0, 0.05]),
    ],
)
def test_integer_times_stay_times(tmp_path: Path, names: list[str], expected: list[float]) -> None:
    assert times(write_named(tmp_path, names)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("name", ["{:010d}", "16000000{:02d}", "{}.5", "frame{}"])
@pytest.mark.parametrize("place", [".", "left"])
def test_a_times_file_wins_over_names_and_may_have_numbers_and_exposures(
    tmp_path: Path, name: str, place: str
) -> None:
    folder = write_named(tmp_path, [name.format(k) for k in range(4)])
    path = folder / place / "times.txt"
    rows = [f"{k:05d} {7 + 0.25 * k:.6f} 1.5e-3\n" for k in range(4)]
    for text in ("7.0\n7.25\n7.5\n7.75\n", "".join(rows)):
        path.write_text(text)
        assert times(folder) == [7.0, 7.25, 7.5, 7.75]
    assert path in open_source(folder).files
    assert times(folder, rate_hz=5.0) == pytest.approx([0, 0.2, 0.4, 0.6])
    path.write_text("".join([*rows[:2], rows[1], rows[3]]))
    with pytest.raises(SourceError, match=r"times\.txt:3: two images have the same timestamp"):
        times(folder)
    path.write_text("1 2\n3 4\n")
    with pytest.raises(FormatError, match="got 2, expected 1 or 3"):
        times(folder)


def test_partners_are_found_among_names_of_many_rigs() -> None:
    for left, right in (
        ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
        ("/zed/left/image_rect", "/zed/right/image_rect"),
        ("/left_cam/left/image", "/right_cam/right/image"),
        ("/cam0/image_raw", "/cam1/image_raw"),
        ("image_left", "image_right"),
        ("L", "R"),
    ):
        assert find_partners([right, "/other", left]) == [(left, right)]
    assert find_partners(["/front/image", "/rear/image"]) == []


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


@pytest.mark.parametrize(
    ("left", "right", "expected", "by_order"),
    [
        # By their numbers, where names differ in the side.
        (["left1.png", "left02.png", "left10.png"],
         ["right10.png", "right01.png", "right2.png", "right.txt"],
         ["left1.png right01.png", "left02.png right2.png", "left10.png right10.png"], False),
        # A number of the camera does not count.
        (["left0_7.png", "left0_8.png"], ["right1_8.png", "right1_7.png"],
         ["left0_7.png right1_7.png", "left0_8.png right1_8.png"], False),
        # By name, whatever the suffix.
        (["left/a.png", "left/b.png"], ["right/b.jpg", "right/a.jpg"],
         ["a.png a.jpg", "b.png b.jpg"], False),
        # By order, where names have nothing in common.
        (["left/100.png", "left/200.png"], ["right/101.png", "right/202.png"],
         ["100.png 101.png", "200.png 202.png"], True),
        (["left_a.png"], ["right_b.png"], ["left_a.png right_b.png"], False),
    ],
)  # fmt: skip
def test_images_are_paired_by_name_by_number_or_in_order(
    tmp_path: Path, left: list[str], right: list[str], expected: list[str], by_order: bool
) -> None:
    touch(tmp_path, *left, *right)
    sides = ("left", "right") if "/" in left[0] else ("left*", "right*")
    found = pair_images(*(str(tmp_path / side) for side in sides))
    assert [f"{one.name} {other.name}" for one, other in found.pairs] == expected
    assert found.by_order == by_order


def test_images_without_a_partner_are_left_out_and_named(tmp_path: Path) -> None:
    touch(tmp_path, *(f"left{n}.png" for n in (1, 2, 3, 5)), "left_notes.png")
    touch(tmp_path, *(f"right{n}.png" for n in (1, 2, 3, 4)), "right_7_again.png")
    found = pair_images(str(tmp_path / "left*"), str(tmp_path / "right*"))
    assert [left.name for left, _ in found.pairs] == ["left1.png", "left2.png", "left3.png"]
    names = {path.name for path in found.lonely}
    assert names == {"left5.png", "left_notes.png", "right4.png", "right_7_again.png"}


@pytest.mark.parametrize(
    ("names", "left", "right", "message"),
    [
        ("l1.png l2.png l3.png r3.png r4.png r5.png", "l*", "r*",
         r"most have no partner \(got 1 pair of 3 left, 3 right; l1\.png, l2\.png, r4\.png …"),
        ("lx.png ly.png r.png", "l*", "r*", r"do not pair up \(got 2 left, 1 right"),
        ("l1.png r1.png", "*", "*", r"l1\.png: left and right are the same images"),
        ("l1.txt", "l*", "r*", r"no images found.*in quotes"),
    ],
)  # fmt: skip
def test_patterns_of_images_that_are_no_pairs_are_refused(
    tmp_path: Path, names: str, left: str, right: str, message: str
) -> None:
    touch(tmp_path, *names.split())
    with pytest.raises(SourceError, match=message):
        pair_images(str(tmp_path / left), str(tmp_path / right))
