"""What commands say in a terminal while they work: from the first moment on, with bars."""

import re
from pathlib import Path

import numpy as np
import pytest

from recon.core.values.board import parse_board
from recon.io.images.image import write_image
from tests.hostile.refusals import run
from tests.scenery.boards import board_rig, place_boards, render_views
from tests.scenery.kitti import street_drive
from tests.scenery.middlebury import write_scene
from tests.scenery.terminal import COLUMNS, show
from tests.sources.drives import write_video

pytestmark = pytest.mark.slow  # but for the first test, commands of seconds


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a drive, two finished runs, a scene, images of a board, and a batch."""
    folder = tmp_path_factory.mktemp("terminal")
    drive = street_drive(folder / "drive", 8, 192)
    later = street_drive(folder / "drive2", 8, 192, seed=0, speed_m_per_frame=0.45)
    for name, source in {"run": drive, "later": later}.items():
        done = run(
            "map",
            source,
            "--out",
            folder / name,
            *("--set=audit.quick=false", "--set=scene.scale=1"),
        )
        assert done.code == 0, done.err
    write_scene(folder / "scenes" / "square")
    rig, board = board_rig(), parse_board("chess:9x6:25mm")
    for number, views in enumerate(render_views(rig, board, place_boards(rig, board, 8, seed=4))):
        for side, view in zip(("left", "right"), views, strict=True):
            write_image(folder / "boards" / side / f"{number:02d}.png", view)
    for side in ("left", "right"):
        seen = [np.full((96, 128), 80 + number, np.uint8) for number in range(20)]
        write_video(folder / f"{side}.avi", seen)
    (folder / "jobs.toml").write_text(
        "[[job]]\nname = 'one'\ncommand = 'audit'\nsource = ['drive']\n"
    )
    return folder


SCENE = "scenes/square/im0.png scenes/square/im1.png"
TRUTH = "drive/poses.txt"
COMMANDS = [
    ("map drive --out new", r"drive .*\d/8"),
    ("audit drive", r"look at the images .*\d/\d"),
    ("export run --to cloud,mesh,mcap --images drive --out products", r"mcap .*\d/\d .*images/s"),
    ("export run --to costmap,gridmap --out ros", r"costmap .*\d/\d.* tiles"),
    ("mesh run --out mesh --set mesh.min_component_faces=1", r"mesh .*\d/\d"),
    ("occupancy run --out grid", r"grid .*\d/\d"),
    ("merge run later --out merged", r"cut into tiles .*\d/\d"),
    ("diff run later --out changes", r"compare "),
    ("localize drive --map run --out found", r"drive .*\d/8"),
    (f"pair {SCENE} --calib scenes/square/calib.txt --out pair", r"match "),
    (f"disparity {SCENE} --out disparity", r"match "),
    ("rectify boards/left boards/right --out straight", r"rectify .*\d/8"),
    (
        "calibrate boards/left boards/right --board chess:9x6:25mm --report r --out c.yaml",
        r"find the board .*\d+/16",
    ),
    ("capture left.avi right.avi --out captured", r"record .*\d+/\?"),
    ("evaluate middlebury scenes --out bench", r"scenes .*\d/1"),
    ("evaluate map run later/map/cloud.ply --out compared", r"compare "),
    ("batch jobs.toml --workers 1 --out week", r"week .*1/1"),
    ("doctor", r"examine .*\d+/\?"),
]


@pytest.mark.parametrize(("words", "bar"), COMMANDS, ids=[words for words, _ in COMMANDS])
def test_a_command_says_what_it_does_from_its_first_moment_on(place, monkeypatch, words, bar):
    monkeypatch.chdir(place)
    shown = show(*words.split())
    assert shown.code == 0, shown.lines[-8:]
    assert shown.lines[0].startswith("starting")  # before anything is loaded that takes a moment
    assert any(re.search(bar, line) for line in shown.lines), shown.lines
    drawn = [line for line in shown.lines if "━" in line]
    assert max(map(len, drawn)) <= COLUMNS
    assert words == "doctor" or shown.lines[-1].startswith("next  ")


def test_nothing_is_left_of_a_bar_where_a_command_is_wrong_or_quiet(tmp_path: Path):
    wrong = show("map", str(tmp_path / "none"))
    assert wrong.code == 1
    assert re.match(r"error: .*none", wrong.lines[-1].rpartition("\x1b")[2])
    quiet = show("audit", str(street_drive(tmp_path / "drive", 6, 128)), "--quiet")
    assert "━" not in "".join(quiet.lines)
