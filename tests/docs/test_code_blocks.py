"""What README and docs show runs, from the pages themselves."""

import os
import re
import subprocess
import sys

import pytest
import typer.main

from recon.cli import app
from tests.docs.blocks import PAGES, ROOT, Block, blocks_of, commands_in
from tests.docs.stand_ins import prepare

BLOCKS = [block for page in PAGES for block in blocks_of(page)]
SHELL = [block for block in BLOCKS if block.language == "sh"]
RUNNING = sorted({block.page for block in BLOCKS if block.language in ("sh", "python")})

SHOWN = {"text", "yaml", "json", "toml"}
"""Languages of blocks that are output, trees of files, diagrams or configuration."""

NOT_RUN = {
    r"make \w": "the tests themselves are run by it",
    r"git clone": "needs a network",
    r"source .venv/bin/activate": "the tests run in an environment that is active",
    r"pip install": "changes the environment; tests/docs/stand_ins.py installs the package",
    r"recon map rgbd_dataset_": "needs data; tests/sources/test_rgbd.py maps a rendered one",
    r"python benchmarks/two_checkouts": "takes long; tests/flow/test_speed_gate.py has its parts",
    r"recon datasets (fetch|verify)": "needs a network; tests/commands/test_datasets.py has one",
    r"dask |for host in |sbatch |kubectl |recon (batch|map) .* --scheduler": "needs a cluster",
    r"recon capture 0 2": "needs two cameras; tests/commands/test_cameras.py records from videos",
    r"recon view ": "shows until Ctrl-C; tests/flow/test_view.py looks at it",
    r"recon live (0|/dev/)": "needs cameras; tests/flow/test_live.py plays videos as such",
}
"""Beginnings of shell lines that are checked but not run, and why."""


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_a_block_says_whether_it_runs(block):
    assert block.language in {"sh", "python", *SHOWN}


@pytest.mark.parametrize("block", SHELL, ids=str)
def test_a_shell_block_is_shell_with_commands_of_the_program(block):
    done = subprocess.run(
        ["bash", "-n"], input=block.text, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for name, *arguments in commands_in(block.text):
        if name == "recon":
            command = typer.main.get_command(app)
            words = list(arguments)
            while hasattr(command, "commands"):
                command = command.commands[words.pop(0)]
            command.make_context("recon", words)  # fails where an option does not exist


def test_nothing_is_left_out_without_need():
    lines = [line for block in SHELL for line in block.text.splitlines()]
    unused = [start for start in NOT_RUN if not any(re.match(start, line) for line in lines)]
    assert unused == []


def as_command(block: Block) -> list[str]:
    if block.language == "python":
        return [sys.executable, "-c", block.text]
    lines = block.text.splitlines()
    run = [line for line in lines if not any(re.match(start, line) for start in NOT_RUN)]
    return ["bash", "-e", "-c", "\n".join(run)]


@pytest.fixture
def environment(tmp_path):
    """A home of its own, and this `recon` among the programs."""
    program = tmp_path / "bin" / "recon"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m recon "$@"\n')
    program.chmod(0o755)
    return {
        **os.environ,
        "HOME": str(tmp_path / "home"),
        "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path / 'work' / 'site'}",
    }


@pytest.mark.slow
@pytest.mark.timeout(1800)  # README alone runs some twenty commands
@pytest.mark.parametrize("page", RUNNING)
def test_the_blocks_of_a_page_run_in_order(page, tmp_path, environment):
    """In a folder with small stand-ins for the files that they name."""
    blocks = [block for block in BLOCKS if block.page == page and block.language not in SHOWN]
    folder = tmp_path / "work"
    folder.mkdir()
    prepare("\n".join(block.text for block in blocks), folder, tmp_path / "home")
    for block in blocks:
        done = subprocess.run(
            as_command(block), cwd=folder, env=environment, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{block}:\n{block.text}\n{done.stdout}\n{done.stderr}"
