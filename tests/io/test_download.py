"""Downloads end with the right bytes or with one line, whatever the server does."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.errors import DownloadError, OutputError
from recon.io import download as module
from recon.io.download import Promise, digest_of, download, fetch_text
from tests.io.mirror import Mirror, serving

CONTENT = np.random.default_rng(0).bytes(3_500_000)
SHA256 = f"sha256:{hashlib.sha256(CONTENT).hexdigest()}"
PROMISE = Promise(len(CONTENT), SHA256)


@pytest.fixture(autouse=True)
def _no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_PAUSE_S", 0.0)


@pytest.fixture
def mirror() -> Iterator[Mirror]:
    with serving(Mirror({"/a.zip": CONTENT})) as served:
        yield served


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("digest", [SHA256, f"md5:{hashlib.md5(CONTENT).hexdigest()}", None])  # noqa: S324
def test_a_download_is_what_the_server_has(
    mirror: Mirror, tmp_path: Path, digest: str | None
) -> None:
    told: list[tuple[int, int | None]] = []
    download(
        f"{mirror.address}/a.zip",
        tmp_path / "a.zip",
        Promise(None, digest),
        lambda done, total: told.append((done, total)),
    )
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert names(tmp_path) == {"a.zip"}
    assert told[-1] == (len(CONTENT), len(CONTENT))


def test_a_connection_that_breaks_off_goes_on_where_it_was(mirror: Mirror, tmp_path: Path) -> None:
    mirror.break_after = 1_200_000
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked == ["", "bytes=1200000-", "bytes=2400000-"]


def test_a_later_call_goes_on_where_an_earlier_one_broke_off(
    mirror: Mirror, tmp_path: Path
) -> None:
    def interrupt(done: int, total: int | None) -> None:
        if done > 1_500_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE, interrupt)
    assert "a.zip" not in names(tmp_path)
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked == ["", "bytes=2000000-"]


@pytest.mark.parametrize("change", ["no ranges", "another file"])
def test_a_download_begins_anew_where_it_cannot_go_on(
    mirror: Mirror, tmp_path: Path, change: str
) -> None:
    mirror.break_after = 1_000_000
    with pytest.raises(DownloadError):
        download(f"{mirror.address}/b.zip", tmp_path / "a.zip", Promise())
    (tmp_path / "a.zip.part").write_bytes(b"x" * 1000)
    (tmp_path / "a.zip.part.version").write_text('["\\"old\\"", 3500000]')
    mirror.break_after = None
    mirror.ranges = change == "another file"
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT
    assert mirror.asked[-1] == "bytes=1000-"


def test_a_server_that_always_breaks_off_is_given_up(mirror: Mirror, tmp_path: Path) -> None:
    mirror.break_after = 0
    with pytest.raises(DownloadError, match=r"again and again .*0 of 3500000 bytes") as told:
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert "goes on from there" in str(told.value)
    assert len(mirror.asked) == 5


def test_a_busy_server_is_asked_again(mirror: Mirror, tmp_path: Path) -> None:
    mirror.busy = 3
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT


def test_a_redirection_is_followed(mirror: Mirror, tmp_path: Path) -> None:
    mirror.redirect = f"{mirror.address}/moved"
    download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert (tmp_path / "a.zip").read_bytes() == CONTENT


@pytest.mark.parametrize("target", ["file:///etc/hostname?", "ftp://127.0.0.1", "gopher://x"])
def test_a_redirection_to_anything_but_http_is_refused(
    mirror: Mirror, tmp_path: Path, target: str
) -> None:
    mirror.redirect = target
    with pytest.raises(DownloadError):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert "a.zip" not in names(tmp_path)


def test_wrong_bytes_are_refused_and_removed(mirror: Mirror, tmp_path: Path) -> None:
    mirror.files["/a.zip"] = CONTENT[:-1] + b"x"
    with pytest.raises(DownloadError, match=r"not what was promised .*got sha256:.*sha256"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert names(tmp_path) == set()


@pytest.mark.parametrize("claimed", [None, 5_000_000, 1_000_000])
def test_lies_about_the_size_give_one_line(
    mirror: Mirror, tmp_path: Path, claimed: int | None
) -> None:
    mirror.claimed = claimed
    if claimed is None:  # no size at all is no lie
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
        assert (tmp_path / "a.zip").read_bytes() == CONTENT
        return
    with pytest.raises(DownloadError, match=r"another file than .*expected 3500000 bytes"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)
    assert "a.zip" not in names(tmp_path)


def test_more_than_was_promised_is_not_received(mirror: Mirror, tmp_path: Path) -> None:
    mirror.claimed = None
    with pytest.raises(DownloadError, match="sends more than it said"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", Promise(1_000_000))
    assert names(tmp_path) == set()


def test_a_file_that_is_not_there_is_one_line(mirror: Mirror, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match=r"refuses the file .*404"):
        download(f"{mirror.address}/b.zip", tmp_path / "b.zip", Promise())
    assert len(mirror.asked) == 1


@pytest.mark.parametrize("address", ["file:///etc/hostname", "a.zip", "ftp://127.0.0.1/a"])
def test_other_addresses_are_refused(tmp_path: Path, address: str) -> None:
    with pytest.raises(DownloadError, match="not an address"):
        download(address, tmp_path / "a", Promise())


def test_a_full_disk_is_one_line(
    mirror: Mirror, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=1))
    with pytest.raises(OutputError, match="no room for the download"):
        download(f"{mirror.address}/a.zip", tmp_path / "a.zip", PROMISE)


def test_a_small_file_is_read_as_text(mirror: Mirror, tmp_path: Path) -> None:
    mirror.files["/a.zip.md5"] = b"0123456789abcdef  a.zip\n"
    assert fetch_text(f"{mirror.address}/a.zip.md5").split()[0] == "0123456789abcdef"


def test_a_digest_names_its_kind(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(CONTENT)
    assert digest_of(tmp_path / "a", "sha256") == SHA256
