"""Downloads end with the right bytes or with one line, whatever the server does."""

from __future__ import annotations

import io
import stat
import tarfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.errors import DownloadError, FormatError, OutputError
from recon.io import download as module
from recon.io.download import OnBytes, download, unpack
from tests.io.mirror import Mirror, serving

CONTENT = np.random.default_rng(0).bytes(3_500_000)
SIZE = len(CONTENT)


@pytest.fixture(autouse=True)
def _no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)


@pytest.fixture
def mirror() -> Iterator[Mirror]:
    with serving(Mirror({"/a.zip": CONTENT})) as served:
        yield served


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_download_is_what_the_server_has(mirror: Mirror, tmp_path: Path) -> None:
    told: list[tuple[int, int | None]] = []
    mirror.redirect, mirror.busy = f"{mirror.address}/moved", 3
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", None, lambda *now: told.append(now))
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert names(tmp_path) == {"a.zip"}
    assert told[-1] == (SIZE, SIZE)


def test_a_connection_that_breaks_off_goes_on_where_it_was(mirror: Mirror, tmp_path: Path) -> None:
    mirror.break_after = 1_200_000
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked == ["", "bytes=1199999-", "bytes=2399998-"]


def interrupt_at(size: int) -> OnBytes:
    def on_bytes(done: int, total: int | None) -> None:
        if done >= size:
            raise KeyboardInterrupt

    return on_bytes


def test_a_later_call_goes_on_where_an_earlier_one_broke_off(
    mirror: Mirror, tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE, interrupt_at(1_500_000))
    assert "a.zip" not in names(tmp_path)
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked == ["", "bytes=1999999-"]


@pytest.mark.parametrize("change", ["no ranges", "another file"])
def test_a_download_begins_anew_where_it_cannot_go_on(
    mirror: Mirror, tmp_path: Path, change: str
) -> None:
    mirror.break_after = 1_000_000
    with pytest.raises(DownloadError):
        download(f"{mirror.address}/b.zip", tmp_path / "a.zip")
    (tmp_path / "a.zip.part").write_bytes(b"x" * 1000)
    (tmp_path / "a.zip.part.version").write_text('"old"')
    mirror.break_after = None
    mirror.ranges = change == "another file"
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked[-1] == "bytes=999-"


def test_a_server_that_always_breaks_off_is_given_up(mirror: Mirror, tmp_path: Path) -> None:
    mirror.break_after = 0
    with pytest.raises(DownloadError, match=r"again and again .*0 of 3500000 bytes") as told:
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert "goes on from there" in str(told.value)
    assert len(mirror.asked) == 5


@pytest.mark.parametrize("target", ["file:///etc/hostname?", "ftp://127.0.0.1", "gopher://x"])
def test_a_redirection_to_anything_but_http_is_refused(
    mirror: Mirror, tmp_path: Path, target: str
) -> None:
    mirror.redirect = target
    with pytest.raises(DownloadError):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert "a.zip" not in names(tmp_path)


def test_a_file_that_is_complete_is_not_received_again(mirror: Mirror, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE, interrupt_at(SIZE))
    assert names(tmp_path) == {"a.zip.part", "a.zip.part.version"}
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked[-1] == f"bytes={SIZE - 1}-"


@pytest.mark.parametrize("claimed", [None, 5_000_000, 1_000_000])
def test_lies_about_the_size_give_one_line(
    mirror: Mirror, tmp_path: Path, claimed: int | None
) -> None:
    mirror.claimed = claimed
    if claimed is None:  # no size at all is no lie
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
        assert (tmp_path / "a.zip").read_bytes() == CONTENT
        return
    with pytest.raises(DownloadError, match=r"another file than .*expected 3500000 bytes"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)
    assert "a.zip" not in names(tmp_path)


def test_more_than_was_promised_is_not_received(mirror: Mirror, tmp_path: Path) -> None:
    mirror.claimed = None
    with pytest.raises(DownloadError, match="sends more than it said"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", 1_000_000)
    assert names(tmp_path) == set()


def test_a_file_that_is_not_there_is_one_line(mirror: Mirror, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"refuses the file .*404"):
        download(f"{mirror.address}/b.zip", tmp_path / "b.zip")
    assert len(mirror.asked) == 1


@pytest.mark.parametrize("address", ["file:///etc/hostname", "a.zip", "ftp://127.0.0.1/a"])
def test_other_addresses_are_refused(tmp_path: Path, address: str) -> None:
    with pytest.raises(DownloadError, match="not an address"):
        download(address, tmp_path / "a")


def test_a_full_disk_is_one_line(
    mirror: Mirror, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=1))
    with pytest.raises(OutputError, match="no room for the download"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", SIZE)


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
