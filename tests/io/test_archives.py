"""Archives are unpacked where they belong; hostile ones write nothing outside."""

from __future__ import annotations

import io
import stat
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from recon.core.errors import FormatError
from recon.io.download import unpack

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


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("kind", ["zip", "tar", "tar.gz"])
def test_everything_is_unpacked_over_what_was_there(tmp_path: Path, kind: str) -> None:
    path = tmp_path / f"a.{kind}"
    write_zip(path) if kind == "zip" else write_tar(path, mode="w:gz" if "gz" in kind else "w")
    unpack(write_zip(tmp_path / "before.zip", {"README": b"four"}), tmp_path / "out")
    unpack(path, tmp_path / "out")
    assert content(tmp_path / "out") == FILES


def test_only_what_is_chosen_is_unpacked(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.zip", {**FILES, "__MACOSX/data/._a": b"x", "data/d.bag": b"y"})
    unpack(path, tmp_path / "out", below="data", without=[".bag"])
    assert content(tmp_path / "out") == {"a.txt": b"one", "b/c.png": b"two"}
    with pytest.raises(FormatError, match=r"archive is empty .*below nowhere"):
        unpack(path, tmp_path / "out", below="nowhere")


def test_archives_in_an_archive_are_unpacked_beside_themselves(tmp_path: Path) -> None:
    inner = write_zip(tmp_path / "inner.zip", {"mav0/a": b"one"}).read_bytes()
    path = write_zip(tmp_path / "a.zip", {"hall/MH/MH.zip": inner, "hall/MH/MH.bag": b"x"})
    unpack(path, tmp_path / "out", below="hall", without=[".bag"], zips=True)
    assert content(tmp_path / "out") == {"MH/mav0/a": b"one"}


@pytest.mark.parametrize(
    "name",
    ["../a", "/etc/a", "b/../../a", "b/../a", "..", "c:/a", "c:a", "b\\a", "\\\\host\\a", "a\x07b"],
)
@pytest.mark.parametrize("write", [write_zip, write_tar])
def test_paths_outside_are_refused(tmp_path: Path, write: object, name: str) -> None:
    path = write(tmp_path / "a", {"good": b"1", name: b"2"})  # type: ignore[operator]
    with pytest.raises(FormatError, match="path outside of itself"):
        unpack(path, tmp_path / "deep" / "out")
    assert set(content(tmp_path)) <= {"a", "deep/out/good"}


def test_a_name_of_a_zip_that_hides_its_end_is_refused(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.zip", {"aXb": b"1"})
    path.write_bytes(path.read_bytes().replace(b"aXb", b"a\0b"))
    with pytest.raises(FormatError):
        unpack(path, tmp_path / "out")


def link_tar(path: Path, kind: bytes, name: str, target: str) -> Path:
    with tarfile.open(path, "w") as file:
        info = tarfile.TarInfo(name)
        info.type, info.linkname = kind, target
        file.addfile(info)
        after = tarfile.TarInfo(f"{name}/x")
        after.size = 1
        file.addfile(after, io.BytesIO(b"x"))
    return path


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE])
@pytest.mark.parametrize("target", ["/etc", "../..", "../../../etc/passwd"])
def test_links_that_lead_out_are_refused(tmp_path: Path, kind: bytes, target: str) -> None:
    path = link_tar(tmp_path / "a.tar", kind, "dso/images", target)
    with pytest.raises(FormatError, match="path outside of itself"):
        unpack(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "target"), [(tarfile.SYMTYPE, "../mav0"), (tarfile.LNKTYPE, "mav0/x")]
)
def test_links_that_stay_are_left_out(tmp_path: Path, kind: bytes, target: str) -> None:
    path = link_tar(tmp_path / "a.tar", kind, "dso/images", target)
    unpack(path, tmp_path / "out")
    assert content(tmp_path / "out") == {"dso/images/x": b"x"}
    assert not (tmp_path / "out" / "dso" / "images").is_symlink()


def test_a_link_in_a_zip_that_leads_out_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        info = zipfile.ZipInfo("link")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        file.writestr(info, "/etc/passwd")
    with pytest.raises(FormatError, match="path outside of itself"):
        unpack(tmp_path / "a.zip", tmp_path / "out")


def test_devices_are_refused(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "a.tar", "w") as file:
        info = tarfile.TarInfo("pipe")
        info.type = tarfile.FIFOTYPE
        file.addfile(info)
    with pytest.raises(FormatError, match="device"):
        unpack(tmp_path / "a.tar", tmp_path / "out")


def test_two_entries_of_one_name_are_refused(tmp_path: Path) -> None:
    path = write_tar(tmp_path / "a.tar", {"a": b"1", "./a": b"2"})
    with pytest.raises(FormatError, match="one name"):
        unpack(path, tmp_path / "out")


@pytest.mark.parametrize("kind", ["in one", "in another", "empty files"])
def test_a_bomb_is_refused_before_it_fills_the_disk(tmp_path: Path, kind: str) -> None:
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
@pytest.mark.parametrize("write", [write_zip, write_tar])
def test_damaged_archives_are_one_line(tmp_path: Path, write: object, damage: str) -> None:
    path = write(tmp_path / "a", {"a.bin": bytes(range(256)) * 40})  # type: ignore[operator]
    good = bytearray(path.read_bytes())
    good[50] ^= 0xFF
    path.write_bytes(
        {"cut": good[:700], "changed": bytes(good), "empty": b"", "text": b"no archive"}[damage]
    )
    with pytest.raises(FormatError, match=str(path)):
        unpack(path, tmp_path / "out")
