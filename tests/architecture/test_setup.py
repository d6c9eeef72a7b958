"""`scripts/setup.sh` on machines that lack something: what it says, and what it leaves."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

#: Stands for Python, pip and uv: notes what it is called for, and fails where it is told to.
STUB = """#!/bin/bash
echo "$(basename "$0") $*" >>"$CALLS"
case " $(basename "$0") $* " in
    *sys.version_info*) exec "{python}" "$@" ;;
    *" -m venv "*)
        mkdir -p .venv/bin
        cp "$0" .venv/bin/python ;;
    *" install --require-hashes "*) cp "$0" .venv/bin/uv ;;
esac
[[ -z $FAILS || " $(basename "$0") $* " != *$FAILS* ]]
"""
LOCK = r"""six==1 \
    --hash=sha256:1
uv==2 \
    --hash=sha256:2 \
    --hash=sha256:3
zipp==4 \
"""


class Machine:
    """A checkout, and a PATH with nothing but what a stub does."""

    def __init__(self, folder: Path, root: Path) -> None:
        self._folder, self._calls = folder, folder / "calls"
        (folder / "scripts").mkdir()
        shutil.copy(root / "scripts" / "setup.sh", folder / "scripts")
        (folder / "constraints.lock").write_text(LOCK)
        self._tools = folder / "tools"
        self._tools.mkdir()
        for name in ("bash", "dirname", "basename", "env", "cp", "mkdir", "sed", "cat"):
            (self._tools / name).symlink_to(shutil.which(name) or f"/bin/{name}")
        # Nothing of the system lacks.
        libraries = "libGL.so.1 libEGL.so.1 libX11.so.6 libusb-1.0.so.0 libOpenGL.so.0"
        self.write("ldconfig", f"#!/bin/bash\nprintf '%s \\n' {libraries}\n")
        self.write("python3", STUB.format(python=sys.executable))

    def write(self, name: str, text: str) -> None:
        (self._tools / name).write_text(text)
        (self._tools / name).chmod(0o755)

    def set_up(self, *words: str, fails: str = "", **given: str) -> tuple[int, str, list[str]]:
        """Exit status, what was printed, and the programs that were called."""
        self._calls.write_text("")
        done = subprocess.run(
            ["scripts/setup.sh", *words], cwd=self._folder, capture_output=True, text=True,
            check=False, timeout=60,
            env={"PATH": str(self._tools), "CALLS": str(self._calls), "FAILS": fails, **given},
        )  # fmt: skip
        calls = [
            line for line in self._calls.read_text().splitlines() if "version_info" not in line
        ]
        return done.returncode, done.stdout + done.stderr, calls

    def lies(self, name: str) -> bool:
        return (self._folder / name).exists()


@pytest.fixture
def machine(tmp_path, root):
    return Machine(tmp_path, root)


def test_uv_comes_by_its_hashes_and_installs_what_commands_run(machine):
    code, said, calls = machine.set_up()
    assert code == 0, said
    assert "python3 -m venv --clear .venv" in calls
    (uv,) = (call for call in calls if call.startswith("uv "))
    assert uv == "uv pip install --python .venv/bin/python -c constraints.lock -e ."
    fetched = (Path(machine._folder) / ".venv" / "uv.txt").read_text()
    assert fetched == "uv==2 \\\n    --hash=sha256:2 \\\n    --hash=sha256:3\n"
    assert "pyoctomap" not in calls[-1]


def test_tests_get_what_they_need_beside(machine):
    code, said, calls = machine.set_up("dev")
    assert code == 0, said
    assert [call for call in calls if call.endswith(" -e .[dev]")]
    assert "pyoctomap" in calls[-1]


def test_the_uv_of_the_machine_is_taken(machine):
    machine.write("uv", STUB.format(python=sys.executable))
    code, said, calls = machine.set_up()
    assert code == 0, said
    assert not machine.lies(".venv/bin/uv")
    assert [call for call in calls if call.startswith("uv pip install")]


def test_where_uv_cannot_be_had_pip_installs_and_what_is_not_checked_is_said(machine):
    code, said, calls = machine.set_up("dev", fails="--require-hashes")
    assert code == 0, said
    assert "does not check the hashes" in said
    assert calls[-2].endswith("install -c constraints.txt -e .[dev]")


def test_pip_installs_where_that_is_asked_for(machine):
    machine.write("uv", STUB.format(python=sys.executable))
    code, said, calls = machine.set_up(UV="no")
    assert code == 0, said
    assert not [call for call in calls if call.startswith("uv ")]


@pytest.mark.parametrize("fails", ["uv pip install", " install "])
def test_without_a_network_one_line_says_that_it_can_be_run_again_and_it_can(machine, fails):
    code, said, calls = machine.set_up(fails=fails)
    assert code == 1
    assert said.splitlines()[-1].startswith("setup: the libraries could not be installed")
    assert "run it again" in said
    assert ("UV=no" in said) == (fails == "uv pip install")
    assert " -W ignore -c import" not in calls[-1]  # nothing goes on after that
    code, said, calls = machine.set_up()
    assert code == 0, said
    assert not [call for call in calls if " -m venv " in call]  # what was there stays


def test_an_environment_that_was_begun_is_made_anew(machine):
    machine.set_up()
    code, said, calls = machine.set_up(fails="-m pip --version")
    assert code == 0, said
    assert [call for call in calls if "-m venv --clear .venv" in call]


def test_a_library_that_cannot_be_loaded_is_no_success(machine):
    code, said, _ = machine.set_up(fails="import cv2")
    assert code == 1
    assert "one cannot be loaded" in said


def test_another_python_than_those_supported_is_refused_before_anything_is_made(machine):
    machine.write("python3", "#!/bin/bash\nexit 1\n")  # as one of 3.9 answers
    machine.write("old", "#!/bin/bash\nexit 1\n")
    code, said, _ = machine.set_up(PYTHON="old")
    assert code == 1
    assert "no Python 3.10 to 3.13 found as old" in said
    assert not machine.lies(".venv")


def test_make_installs_again_where_the_lock_has_changed_and_not_otherwise(root, tmp_path):
    for name in ("Makefile", "pyproject.toml", "constraints.lock"):
        shutil.copy(root / name, tmp_path)
    (tmp_path / "scripts").mkdir()
    (tmp_path / ".venv").mkdir()
    script = tmp_path / "scripts" / "setup.sh"
    script.write_text('#!/bin/bash\necho "set up: $*"\n[[ ! -e broken ]]\n')
    script.chmod(0o755)

    def made(target: str) -> str:
        # The tests may be run by another make, whose options are none of this one's.
        alone = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
        done = subprocess.run(
            ["make", target], cwd=tmp_path, env=alone, capture_output=True, text=True, check=False
        )
        return done.stdout

    (tmp_path / "broken").touch()
    assert made(".venv/.core") == "set up: \n"
    (tmp_path / "broken").unlink()
    assert made(".venv/.core") == "set up: \n"  # what was interrupted is begun again
    assert "set up" not in made(".venv/.core")
    assert made(".venv/.ready") == "set up: dev\n"
    assert "set up" not in made(".venv/.core")
    later = (tmp_path / ".venv" / ".ready").stat().st_mtime + 10
    os.utime(tmp_path / "constraints.lock", (later, later))
    assert made(".venv/.ready") == "set up: dev\n"
