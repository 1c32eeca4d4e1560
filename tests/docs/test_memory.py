"""The commands of docs/memory.md run as they are printed."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from rmc.actors.config import ActorConfig
from rmc.deploy.run.config import WindowConfig

PAGE = (Path(__file__).parents[2] / "docs" / "memory.md").read_text()
SHORT = ("--preset", "debug", "--launcher", "lockstep", "--total-steps", "600")


def ran(at: Path, *words: str) -> str:
    command = [sys.executable, "-m", "rmc.cli.main", *words]
    done = subprocess.run(command, cwd=at, capture_output=True, text=True, timeout=150, check=False)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return done.stdout


@pytest.mark.timeout(400)
def test_its_commands_run(tmp_path: Path) -> None:
    commands = [words.split() for words in re.findall(r"```sh\nrmc (.*)\n```", PAGE)]
    assert [words[0] for words in commands] == ["check-env", "train", "train", "inspect"]
    outputs = [ran(tmp_path, *words, *(SHORT if "--run-dir" in words else ())) for words in commands]
    assert "cannot learn of anything older than 15 steps; episodes last up to 200 (--trained-steps, or" in outputs[0]
    assert outputs[1].splitlines()[-1] == "it fits"
    assert "cannot learn of anything older than 50 steps; episodes last up to 200 (--trained-steps, or" in outputs[2]
    for row in (r"first +h .*%", r"later +action .*%", r"observation, where missing +-?\d"):
        assert re.search(f"^{row}", outputs[3], re.MULTILINE), outputs[3]
    assert (tmp_path / "inspect.png").exists()


def test_its_tables_have_the_defaults_and_every_strategy() -> None:
    window = WindowConfig()
    assert f"| `--trained-steps` | {window.trained_steps} |" in PAGE
    assert f"| `--burn-in` | {window.burn_in} |" in PAGE
    strategies = re.findall(r"^\| `(\w[\w-]*)` \|", PAGE.split("## What a window starts from")[1], re.MULTILINE)
    assert sorted(strategies) == sorted(get_args(get_type_hints(ActorConfig)["state_strategy"]))
    assert len(PAGE.splitlines()) <= 105
