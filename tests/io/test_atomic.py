import os
from pathlib import Path

import pytest

from recon.core.errors import FormatError, OutputError, SettingsError
from recon.io import atomic
from recon.io.atomic import atomic_path, check_targets, exchange, write_bytes, write_text

pytestmark = pytest.mark.portable


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_half_and_raise(target: Path, error: BaseException) -> None:
    with atomic_path(target) as temporary:
        temporary.write_text("half")
        raise error


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_text_appears_whole_under_its_name_and_nothing_else_stays(tmp_path):
    before = os.umask(0o022)
    try:
        write_text(tmp_path / "run" / "a.txt", "größe\n")
    finally:
        os.umask(before)
    assert (tmp_path / "run" / "a.txt").read_bytes() == "größe\n".encode()
    assert (tmp_path / "run" / "a.txt").stat().st_mode & 0o777 == 0o644
    assert names(tmp_path / "run") == ["a.txt"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, FormatError])
def test_a_failing_block_keeps_the_old_file_and_leaves_no_temporary(tmp_path, error):
    target = tmp_path / "a.txt"
    write_text(target, "old")
    with pytest.raises(error):
        write_half_and_raise(target, error("stop"))
    assert target.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_what_the_system_refuses_names_the_target_not_the_temporary(tmp_path):
    target = tmp_path / "a.bin"
    with pytest.raises(OutputError, match=r"a\.bin: cannot write.*No space left") as caught:
        write_half_and_raise(target, OSError(28, "No space left on device", ".x-a.bin"))
    assert caught.value.where == target
    with pytest.raises(OutputError, match="No such file"), atomic_path(target):
        pass
    assert names(tmp_path) == []
    target.touch()  # a file in place of a folder
    with pytest.raises(OutputError, match=r"a\.bin/a\.txt: cannot write the file \(got"):
        write_bytes(target / "a.txt", b"")


def test_what_is_no_regular_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to(os.devnull)
    (tmp_path / "folder").mkdir()
    before = {path.name: path.lstat().st_mode for path in tmp_path.iterdir()}
    for name, kind in (("pipe", "a named pipe"), ("null", "a device"), ("folder", "a folder")):
        with pytest.raises(OutputError, match=f"{name}: cannot write the file .got {kind}"):
            write_text(tmp_path / name, "text")
    assert {path.name: path.lstat().st_mode for path in tmp_path.iterdir()} == before


def test_an_input_is_not_written_under_any_name(tmp_path):
    source, other = tmp_path / "calib.txt", tmp_path / "other"
    for path in (source, other):
        path.write_text("same content")
    (tmp_path / "hard").hardlink_to(source)
    (tmp_path / "soft").symlink_to(source)
    (tmp_path / "soft to soft").symlink_to("soft")
    for name in ("calib.txt", "hard", "soft", "soft to soft", f"../{tmp_path.name}/calib.txt"):
        with pytest.raises(SettingsError, match="would replace an input"):
            check_targets([tmp_path / "new", tmp_path / name], [source])
    check_targets([tmp_path / "new", other], [source, tmp_path / "gone"])


@pytest.mark.parametrize("system", ["linux", "another"])
def test_two_folders_are_exchanged_or_the_old_one_stays(tmp_path, monkeypatch, system):
    new, old = tmp_path / "new", tmp_path / "old"
    for folder in (new, old):
        folder.mkdir()
        (folder / folder.name).touch()
    monkeypatch.setattr(atomic.sys, "platform", system)
    exchange(new, old)
    assert (names(new), names(old)) == (["old"], ["new"])
    with pytest.raises(FileNotFoundError):
        exchange(tmp_path / "none", old)
    assert names(tmp_path) == ["new", "old"]
