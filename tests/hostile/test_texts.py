"""Hostile calibrations, settings and documents: refused in one line that names the file."""

import resource
import warnings
from pathlib import Path
from typing import Final

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import ReconError, SettingsError
from recon.export.make import make
from recon.export.product import ExportContext
from recon.io.cameras.calibration import read_calibration
from recon.io.files import SMALL_FILE_BYTES
from recon.map.drive.sequence import map_sequence
from recon.map.settings import DriveSettings
from recon.run.run import Run
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.hostile.calibrations import EXPANDING, KALIBR, NUMBERS, OPENCV, OURS, deep, replace_one
from tests.hostile.conftest import DRIVE
from tests.hostile.refusals import assert_refused, refusal, run, run_apart
from tests.scenery.bounds import numbers_of

pytestmark = pytest.mark.usefixtures("blank_figures")
LEVELS: Final = 20_000


def refusal_of(path: Path) -> str | None:
    line = refusal(lambda: read_calibration(path, 48, 32))
    assert line is None or path.stem.split("_")[0] in line
    return line


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize(("name", "text", "old"), [
    *(("rig.yaml", OURS, old) for old in ("48", "50.0", "0.1", "1\n")),
    *(("chain.yaml", KALIBR, old) for old in ("50.0", "48", "-0.1", "[48, 32]", "radtan")),
    *(("stereo.yml", OPENCV, old) for old in ("48", "50.", "-0.1", "rows: 3")),
], ids=lambda value: value if len(value) < 10 else "")  # fmt: skip
def test_a_hostile_number_raises_nothing_but_our_errors(name, text, old, number, tmp_path):
    path = tmp_path / name
    path.write_text(replace_one(text, old, NUMBERS[number] + "\n" * old.endswith("\n")))
    line = refusal_of(path)
    never = {"5000 digits", "date", "tag int abc", "list", "nan", "zero"}
    assert line or text != OURS or old == "1\n" or number not in never


@pytest.mark.parametrize("nesting", deep(1))
def test_deep_nesting_is_refused(nesting, tmp_path):
    path, text = tmp_path / "rig.yaml", deep(LEVELS)[nesting]
    path.write_text(text)
    assert refusal_of(path)
    line = refusal(lambda: load_config(path))
    assert "rig.yaml" in line
    assert refusal(lambda: load_config(None, [f"matching={text}"]))


@pytest.mark.slow
@pytest.mark.parametrize("nesting", ["opencv yaml lists", "opencv xml", "opencv json"])
def test_very_deep_nesting_does_not_end_the_process(nesting, pair):
    Path("rig.yml").write_text(deep(200_000)[nesting])
    assert_refused(run_apart("pair", *pair, "--calib", "rig.yml", "--out", "out"), "rig.yml")
    assert not Path("out").exists()


def test_what_is_more_than_any_calibration_is_not_read(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("\n".join([*EXPANDING, replace_one(KALIBR, "[50.0, 50.0, 24.0, 16.0]", "*l9")]))
    assert "aliases" in (refusal_of(path) or "")
    path.write_text(OPENCV.replace("rows: 3", "rows: 300000").replace("cols: 3", "cols: 300000"))
    read_calibration(path, 48, 32)  # matrices larger than their data are not allocated
    with path.open("wb") as file:
        file.truncate(50 * SMALL_FILE_BYTES)
    assert "too large" in (refusal_of(path) or "")


@pytest.mark.parametrize("command", ["pair", "disparity", "rectify", "map", "audit"])
def test_every_command_names_the_file(command, pair, drive):
    Path("rig.yaml").write_text(OURS.replace("48", "!!int abc"))
    inputs = pair if command in {"pair", "disparity", "rectify"} else (drive,)
    out = () if command == "audit" else ("--out", "out")
    assert_refused(run(command, *inputs, "--calib", "rig.yaml", *out), "rig.yaml")
    assert not Path("out").exists()


@pytest.mark.parametrize("number", sorted(set(NUMBERS) - {"minus 1e300", "null"}))
@pytest.mark.parametrize("setting", ["matching.window_px", "source.tolerance_s", "matching"])
def test_a_hostile_value_of_a_setting_is_refused(setting, number):
    assert refusal(lambda: load_config(None, [f"{setting}={NUMBERS[number]}"]))


@pytest.mark.parametrize(
    "key",
    ["", ".", "..", "a" * 5000, ".".join("a" * 5000), "\0", "matching.", ".matching", "é.²", "[1]"],
    ids=["empty", "dot", "dots", "long", "deep", "NUL", "dot last", "dot first", "letters", "list"],
)
def test_a_hostile_name_of_a_setting_is_refused(key):
    assert refusal(lambda: load_config(None, [f"{key}=1"]))


@pytest.mark.parametrize(
    "command", ["pair", "map", "audit", "rectify", "paper", "demo", "calibrate", "mesh"]
)
def test_every_command_names_the_option(command, pair):
    inputs = {
        "pair": (*pair, "--calib", "rig.yaml"),
        "map": (".",),
        "mesh": ("cloud.ply",),
        "audit": (".",),
        "rectify": pair,
        "calibrate": (*pair, "--board", "9x6:25mm"),
    }
    ended = run(command, *inputs.get(command, ()), "--set", "matching.window_px=!!int abc")
    assert_refused(ended, "matching.window_px")
    assert sorted(path.name for path in Path().iterdir()) == ["left.png", "right.png"]


@pytest.mark.parametrize("number", ["1_0", "\u0661\u0662"])
@pytest.mark.parametrize("option", [
    "pair left.png right.png --threads",
    "pair left.png right.png --focal",
    "map drive --focal",
    "evaluate disparity a.pfm b.pfm --scale",
    "piece plan",
])  # fmt: skip
def test_an_option_takes_decimals_alone_for_numbers(option, number, here):
    """Wrong usage, as is any other text that is no number; but a file may be named so."""
    ended = run(*option.split(), number)
    assert ended.code == 2
    assert "Invalid value for" in ended.err
    assert not list(here.iterdir())
    assert_refused(run("map", number), number, "exist")


TEXTS: Final = {
    "nothing": b"",
    "a word": b"word",
    "a list": b"[1]",
    "null": b"null",
    "a list of null": b"[null]",
    "a number": b"5",
    "5000 digits": b"9" * 5000,
    "too large a number": b'{"a": 1e999}',
    "a NUL": b'{"a": "\\u0000"}\x00',
    "a surrogate": b'{"\\ud800": ["\\udfff"]}',
    "nested": b"[" * 100_000,
    "a long name": b"p_" * 50_000,
    "nested mappings": b'{"a":' * 100_000,
    "not UTF-8": b"\xff\xfe{}",
}
READERS: Final = {
    "settings": ("c.yaml", "disparity left.png right.png --config c.yaml"),
    "jobs in YAML": ("jobs.yaml", "batch jobs.yaml"),
    "jobs in TOML": ("jobs.toml", "batch jobs.toml"),
    "calibration": ("calib.yaml", "pair left.png right.png --calib calib.yaml"),
    "poses": ("poses.txt", "map drive --poses poses.txt"),
    "prior": ("prior.txt", "map drive --prior prior.txt"),
    "summary of a pair": ("one/summary.json", "mesh one"),
}


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("reader", READERS)
def test_a_document_that_is_none_is_refused(reader, text, drive, pair):
    name, command = READERS[reader]
    Path("one").mkdir()
    Path("one/run.json").write_text('{"command": "pair"}')
    Path(name).write_bytes(TEXTS[text])
    if reader == "settings" and text in ("nothing", "null"):
        pytest.skip("settings that are left out are the defaults")
    assert_refused(run(*command.split(), "--out", "out"), name)
    assert not Path("out").exists()


@pytest.mark.parametrize("text", TEXTS)
def test_measured_positions_that_are_none_are_refused(text, finished):
    pytest.importorskip("laspy")
    Path("gnss.txt").write_bytes(TEXTS[text])
    words = ("export", "run", "--to", "las", "--georeference", "gnss.txt", "--antenna=0,0,0")
    assert_refused(run(*words, "--out", "out"), "gnss.txt")
    assert not Path("out").exists()


BOUNDED: Final = [one for one in numbers_of(DriveSettings) if "onnx" not in one.name]
# Of address space, for a drive of three small frames that takes a twentieth of it by default.
MORE_BYTES: Final = 4_000_000_000


@pytest.fixture(scope="module")
def street():
    return SyntheticSource(StreetScene(smooth_edges=False, **{**DRIVE, "frames": 3}))


@pytest.fixture
def little_memory():
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MORE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("number", BOUNDED, ids=lambda number: number.name)
@pytest.mark.parametrize("end", ["low", "high"])
def test_a_setting_at_its_bound_gives_a_map_or_one_line(number, end, street, tmp_path):
    value, part, line = getattr(number, end), number.name.split(".")[1], ""
    overrides = [f"{number.name}={int(value) if number.whole else value}"]
    if part in ("sad", "sgm", "opencv"):  # whose settings matter to nobody else
        overrides.append(f"matching.matcher={part}")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of numpy: of what overflows, or is NaN
        try:
            config = load_config(None, overrides)
            with Run("map", tmp_path / "out", config) as made:
                mapped = map_sequence(street, config)
                context = ExportContext(mapped.map, mapped.placed, config.mesh)
                make(context, made.content, ("cloud", "octomap", "grid"))
        except (ReconError, MemoryError) as error:  # a command has a line for either
            line = str(error)
    assert "\n" not in line


def test_margins_beyond_a_tile_are_refused():
    wide = "map_filters.radius_m=51"
    with pytest.raises(SettingsError, match=r"filters.radius_m reaches 51 m, beyond a tile of 50"):
        load_config(None, [wide])
    load_config(None, [wide, "submaps.tile_m=60"])
    with pytest.raises(SettingsError, match=r"mesh\.tile_m.*greater than or equal to 6"):
        load_config(None, ["mesh.tile_m=5.9"]).at_scale(1.0)
    with pytest.raises(SettingsError, match="beyond a tile of 10 m"):
        load_config(None, ["map_filters.radius_m=11"]).at_scale(0.2)
    assert ReconConfig().mesh.tile_m > 6
