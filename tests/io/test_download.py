"""Downloads end with the right bytes or with one line, whatever the server does."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.errors import DownloadError, OutputError
from recon.io import download as module
from recon.io.download import OnBytes, download
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
