"""Downloads end with the right bytes or with one line, whatever the server does."""

import io
import stat
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.errors import DownloadError, FormatError, OutputError
from recon.io import download as module
from recon.io.download import download, unpack
from tests.io.mirror import Mirror, serving

CONTENT = np.random.default_rng(0).bytes(3_500_000)
SIZE = len(CONTENT)


@pytest.fixture
def mirror(monkeypatch):
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)
    with serving(Mirror({"/a.zip": CONTENT})) as served:
        yield served


@pytest.fixture
def fetch(mirror, tmp_path):
    """Download ``a.zip``, or what has that name, into a folder of its own."""

    def fetch(size=SIZE, on_bytes=lambda *_: None, name="a.zip"):
        download(f"{mirror.address}/{name}", tmp_path / "a.zip", size, on_bytes)
        return tmp_path / "a.zip"

    return fetch


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_download_is_what_the_server_has(mirror, fetch):
    told: list[int] = []
    mirror.redirect, mirror.busy = f"{mirror.address}/moved", 3
    path = fetch(None, told.append)
    assert (path.read_bytes(), names(path.parent)) == (CONTENT, {"a.zip"})
    assert told[-1] == SIZE


def test_a_download_goes_on_where_a_connection_breaks_off(mirror, fetch, monkeypatch):
    mirror.break_after = 1_200_000
    assert fetch().read_bytes() == CONTENT
    assert mirror.asked == ["", "bytes=1199999-", "bytes=2399998-"]
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=1))
    with pytest.raises(OutputError, match="not enough disk space"):
        fetch()


# A file that is complete is not received again.
@pytest.mark.parametrize(("size", "asked"), [(1_500_000, 1_999_999), (SIZE, SIZE - 1)])
def test_a_later_call_goes_on_where_an_earlier_one_broke_off(mirror, tmp_path, fetch, size, asked):
    def interrupt(done: int) -> None:
        if done >= size:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fetch(on_bytes=interrupt)
    assert names(tmp_path) == {"a.zip.part", "a.zip.part.version"}
    assert fetch().read_bytes() == CONTENT
    assert mirror.asked == ["", f"bytes={asked}-"]


@pytest.mark.parametrize("change", ["no ranges", "another file"])
def test_a_download_begins_anew_where_it_cannot_go_on(mirror, tmp_path, fetch, change):
    (tmp_path / "a.zip.part").write_bytes(b"x" * 1000)
    (tmp_path / "a.zip.part.version").write_text('"old"')
    mirror.ranges = change == "another file"
    assert fetch().read_bytes() == CONTENT
    assert mirror.asked == ["bytes=999-"]


@pytest.mark.parametrize(
    ("how", "name", "message", "asked"),
    [
        ({"break_after": 0}, "a.zip", r"again and again .*0 of 3500000 bytes.*goes on from", 5),
        ({"redirect": "file:///etc/hostname?"}, "a.zip", "is not allowed", 1),
        ({"redirect": "ftp://127.0.0.1"}, "a.zip", "not encrypted", 1),
        ({"claimed": 5_000_000}, "a.zip", r"another file than .*expected 3500000 bytes", 1),
        ({"claimed": 1_000_000}, "a.zip", r"another file than .*expected 3500000 bytes", 1),
        ({}, "b.zip", r"refuses the file .*404", 1),
    ],
)
def test_a_server_that_does_not_give_the_file_is_one_line(mirror, fetch, how, name, message, asked):
    vars(mirror).update(how)
    with pytest.raises(DownloadError, match=message):
        fetch(name=name)
    assert len(mirror.asked) == asked


def test_a_size_that_is_not_said_is_no_lie_but_more_than_promised_is(mirror, tmp_path, fetch):
    mirror.claimed = None
    with pytest.raises(DownloadError, match="sends more than it said"):
        fetch(1_000_000)
    assert names(tmp_path) == set()
    assert fetch().read_bytes() == CONTENT


@pytest.mark.parametrize("address", ["file:///etc/hostname", "a.zip", "ftp://127.0.0.1/a"])
def test_other_addresses_are_refused(tmp_path, address):
    with pytest.raises(DownloadError, match="not an address"):
        download(address, tmp_path / "a")


FILES = {"data/a.txt": b"one", "data/b/c.png": b"two", "README": b"three"}


def write_zip(path: Path, files: Mapping[str, bytes] = FILES) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in files.items():
            file.writestr(name, content)
    return path


def write_tar(path: Path, files: Mapping[str, bytes] = FILES, mode: str = "w") -> Path:
    with tarfile.open(path, mode) as file:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            file.addfile(info, io.BytesIO(content))
    return path


WRITERS = [write_zip, write_tar]


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("kind", ["zip", "tar", "tar.gz"])
def test_everything_is_unpacked_over_what_was_there(tmp_path, kind):
    path = tmp_path / f"a.{kind}"
    write_zip(path) if kind == "zip" else write_tar(path, mode="w:gz" if "gz" in kind else "w")
    unpack(write_zip(tmp_path / "before.zip", {"README": b"four"}), tmp_path / "out")
    unpack(path, tmp_path / "out")
    assert content(tmp_path / "out") == FILES


def test_only_what_is_chosen_is_unpacked_and_archives_in_it_beside_themselves(tmp_path):
    inner = write_zip(tmp_path / "inner.zip", {"mav0/a": b"one"}).read_bytes()
    path = write_zip(tmp_path / "a.zip", {"hall/MH/MH.zip": inner, "hall/MH/MH.bag": b"x"})
    unpack(path, tmp_path / "inner", below="hall", without=[".bag"], zips=True)
    assert content(tmp_path / "inner") == {"MH/mav0/a": b"one"}
    path = write_zip(tmp_path / "a.zip", {**FILES, "__MACOSX/data/._a": b"x", "data/d.bag": b"y"})
    unpack(path, tmp_path / "out", below="data", without=[".bag"])
    assert content(tmp_path / "out") == {"a.txt": b"one", "b/c.png": b"two"}
    with pytest.raises(FormatError, match=r"archive is empty .*below nowhere"):
        unpack(path, tmp_path / "out", below="nowhere")


@pytest.mark.parametrize(
    "name",
    ["../a", "/etc/a", "b/../../a", "b/../a", "..", "c:/a", "c:a", "b\\a", "\\\\host\\a", "a\x07b"],
)
@pytest.mark.parametrize("write", WRITERS)
def test_paths_outside_are_refused(tmp_path, write, name):
    path = write(tmp_path / "a", {"good": b"1", name: b"2"})
    with pytest.raises(FormatError, match="path outside of itself"):
        unpack(path, tmp_path / "deep" / "out")
    assert set(content(tmp_path)) <= {"a", "deep/out/good"}


def special_tar(path: Path, kind: bytes, name: str, target: str = "") -> Path:
    """Something that is no file, and a file below it."""
    with tarfile.open(path, "w") as file:
        info, after = tarfile.TarInfo(name), tarfile.TarInfo(f"{name}/x")
        info.type, info.linkname, after.size = kind, target, 1
        file.addfile(info)
        file.addfile(after, io.BytesIO(b"x"))
    return path


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE])
@pytest.mark.parametrize("target", ["/etc", "../..", "../../../etc/passwd"])
def test_links_that_lead_out_are_refused(tmp_path, kind, target):
    path = special_tar(tmp_path / "a.tar", kind, "dso/images", target)
    with pytest.raises(FormatError, match="path outside of itself"):
        unpack(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "target"), [(tarfile.SYMTYPE, "../mav0"), (tarfile.LNKTYPE, "mav0/x")]
)
def test_links_that_stay_are_left_out(tmp_path, kind, target):
    unpack(special_tar(tmp_path / "a.tar", kind, "dso/images", target), tmp_path / "out")
    assert content(tmp_path / "out") == {"dso/images/x": b"x"}
    assert not (tmp_path / "out" / "dso" / "images").is_symlink()


def hidden_end(path: Path) -> Path:
    write_zip(path, {"aXb": b"1"})
    path.write_bytes(path.read_bytes().replace(b"aXb", b"a\0b"))
    return path


def link_zip(path: Path) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        info = zipfile.ZipInfo("link")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        file.writestr(info, "/etc/passwd")
    return path


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (hidden_end, "a: "),
        (link_zip, "path outside of itself"),
        (lambda path: special_tar(path, tarfile.FIFOTYPE, "pipe"), "device"),
        (lambda path: write_tar(path, {"a": b"1", "./a": b"2"}), "one name"),
    ],
    ids=["hidden end", "link", "device", "twice"],
)
def test_other_hostile_entries_are_refused(tmp_path, write, message):
    with pytest.raises(FormatError, match=message):
        unpack(write(tmp_path / "a"), tmp_path / "out")


@pytest.mark.parametrize("kind", ["in one", "in another", "empty files"])
def test_a_bomb_is_refused_before_it_fills_the_disk(tmp_path, kind):
    path, bomb = tmp_path / "a.zip", {f"{number}": bytes(55_000_000) for number in range(2)}
    if kind == "empty files":
        write_tar(path, {f"{number}": b"" for number in range(30_000)}, "w:gz")
    elif kind == "in another":
        write_zip(path, {"a.zip": write_zip(tmp_path / "inner.zip", bomb).read_bytes()})
    else:
        write_zip(path, bomb)
    with pytest.raises(FormatError, match="far more than its own size"):
        unpack(path, tmp_path / "out", zips=True)
    assert sum(map(len, content(tmp_path / "out").values())) < 120_000_000


@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "text"])
@pytest.mark.parametrize("write", WRITERS)
def test_damaged_archives_are_one_line(tmp_path, write, damage):
    path = write(tmp_path / "a", {"a.bin": bytes(range(256)) * 40})
    good = bytearray(path.read_bytes())
    good[50] ^= 0xFF
    path.write_bytes(
        {"cut": good[:700], "changed": bytes(good), "empty": b"", "text": b"no archive"}[damage]
    )
    with pytest.raises(FormatError, match=str(path)):
        unpack(path, tmp_path / "out")
