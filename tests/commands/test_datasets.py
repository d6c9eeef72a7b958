"""Data sets arrive as recon reads them, whole or not at all."""

import hashlib
import io
import json
import tarfile
import zipfile
from collections.abc import Mapping

import pytest

from recon.commands.datasets import run_fetch, run_list, run_verify
from recon.core.errors import DownloadError, FormatError, OutputError, SettingsError
from recon.io import download
from recon.sources.datasets import RECORD, datasets, find_parts, parts_of
from recon.sources.registry import open_source, recognise_source
from tests.hostile.refusals import assert_refused, run
from tests.io.mirror import Mirror, serving
from tests.scenery.middlebury import write_scene

SCENE = "middlebury-2014/Pipes"


@pytest.fixture(autouse=True)
def _no_pause(monkeypatch):
    monkeypatch.setattr(download, "_PAUSE_S", 0.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "Pipes"
    write_scene(folder)
    return zipped({f"Pipes-perfect/{path.name}": path.read_bytes() for path in folder.iterdir()})


@pytest.fixture
def mirror(scene):
    with serving(Mirror({"/Pipes-perfect.zip": scene})) as served:
        yield served


def zipped(files: Mapping[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as file:
        for name, content in files.items():
            file.writestr(name, content)
    return out.getvalue()


def tarred(name: str, content: bytes) -> bytes:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as file:
        info = tarfile.TarInfo(name)
        info.size = len(content)
        file.addfile(info, io.BytesIO(content))
    return out.getvalue()


def test_every_address_is_that_of_a_file_and_says_how_it_is_checked():
    parts = [part for dataset in datasets().values() for part in parts_of(dataset)]
    assert len({part.name for part in parts}) == len(parts) > 100
    for part in parts:
        for one in part.archives:
            assert one.path.startswith("https://")
            assert "{" not in one.path
            assert "//" not in one.path.removeprefix("https://")
            hashed = one.digest or part.dataset.digest_beside
            assert bool(hashed) != bool(part.dataset.unchecked)
    for dataset in datasets().values():
        files = {one.file for part in parts_of(dataset) for one in part.archives}
        assert set(dataset.files) <= files


def test_a_scene_arrives_once_as_recon_reads_it(mirror, tmp_path):
    mirror.break_after = 1000
    (found,) = run_fetch([SCENE], tmp_path, address=mirror.address)["datasets"]
    assert found["fetched"]
    assert (recognise_source(found["out"]), len(open_source(found["out"]))) == ("middlebury", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["middlebury-2014"]
    asked = len(mirror.asked)
    assert run_fetch([SCENE], tmp_path, address=mirror.address)["datasets"] == [
        {**found, "fetched": False}
    ]
    assert len(mirror.asked) == asked
    del found["fetched"]
    assert run_verify(["middlebury-2014"], tmp_path)["datasets"] == [found]
    listed = {one["name"]: one for one in run_list(folder=tmp_path)["datasets"]}
    assert set(listed) == set(datasets())
    assert (listed["middlebury-2014"]["fetched"], listed["middlebury-2014"]["parts"]) == (1, 23)
    assert listed["euroc"]["bytes"] == 24_739_377_801
    parts = {one["name"]: one["fetched"] for one in run_list("middlebury-2014", tmp_path)["parts"]}
    assert [name for name, fetched in parts.items() if fetched] == [SCENE]


def test_verification_names_the_file_that_is_not_what_was_unpacked(mirror, tmp_path):
    run_fetch([SCENE], tmp_path, address=mirror.address)
    image = tmp_path / SCENE / "im1.png"
    image.write_bytes(image.read_bytes()[:-1] + b"x")
    with pytest.raises(FormatError, match=r"im1\.png: file of the data set has changed"):
        run_verify([SCENE], tmp_path)
    image.unlink()
    with pytest.raises(FormatError, match=r"im1\.png: file of the data set is missing"):
        run_verify([SCENE], tmp_path)


def test_a_part_of_which_one_archive_is_not_that_of_the_list_does_not_appear(mirror, tmp_path):
    drive = "2011_09_28_drive_0001"
    mirror.files["/2011_09_28_calib.zip"] = zipped({"2011_09_28/calib_cam_to_cam.txt": b"calib"})
    with pytest.raises(DownloadError, match="another file than the list"):
        run_fetch([f"kitti-raw/{drive}"], tmp_path, address=mirror.address)
    assert not (tmp_path / "kitti-raw").exists()


def test_a_hash_beside_the_archive_is_compared(mirror, tmp_path):
    name = "dataset-room1_512_16"
    content = tarred(f"{name}/mav0/cam0/data.csv", b"#")
    mirror.files[f"/{name}.tar"] = content
    for beside, message in (
        (b"0123456789abcdef0123456789abcdef  x\n", "not what was promised"),
        (b"<!DOCTYPE html>", "no hash"),
    ):
        mirror.files[f"/{name}.tar.md5"] = beside
        with pytest.raises(DownloadError, match=message):
            run_fetch(["tum-vi/room1"], tmp_path, address=mirror.address)
    digest = hashlib.md5(content).hexdigest()  # noqa: S324
    mirror.files[f"/{name}.tar.md5"] = f"{digest} *{name}.tar\n".encode()
    run_fetch(["tum-vi/room1"], tmp_path, address=mirror.address)
    record = json.loads((tmp_path / "tum-vi" / "room1" / RECORD).read_text())
    assert record["archives"][0]["checked"] == f"md5:{digest}"
    assert list(record["files"]) == ["mav0/cam0/data.csv"]


def test_a_hostile_archive_leaves_no_data_set_and_a_folder_of_others_is_left_alone(
    mirror, tmp_path
):
    mirror.files["/Pipes-perfect.zip"] = zipped({"Pipes-perfect/a": b"1", "../../../b": b"2"})
    with pytest.raises(FormatError, match="path outside of itself"):
        run_fetch([SCENE], tmp_path / "data", address=mirror.address)
    assert not (tmp_path / "data" / "middlebury-2014").exists()
    assert not list(tmp_path.rglob("b"))
    (tmp_path / SCENE).mkdir(parents=True)
    with pytest.raises(OutputError, match="not made by recon datasets"):
        run_fetch([SCENE], tmp_path, address=mirror.address)


@pytest.mark.parametrize("name", ["kiti-raw", "kitti-raw/2011_09_26_drive_9999", "../x", ""])
def test_unknown_names_are_one_line(tmp_path, name):
    with pytest.raises(SettingsError, match="recon datasets list"):
        find_parts(name)
    assert_refused(run("datasets", "fetch", name, "--folder", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_the_commands_print_json(mirror, tmp_path):
    where = ("--folder", tmp_path, "--json")
    for words in (("list",), ("fetch", SCENE, "--address", mirror.address), ("verify", SCENE)):
        ended = run("datasets", *words, *where)
        assert ended.code == 0, ended.err
        assert json.loads(ended.out)["datasets"]
    assert_refused(run("datasets", "verify", "euroc", *where), "was not fetched")
