"""rmc: as a process of its own, and what it says of a wrong command."""

import subprocess
import sys
from pathlib import Path

import pytest

from rmc.cli import main

COMMAND = (sys.executable, "-m", "rmc.cli.main")


def rmc(
    *words: str, timeout: float = 120, cwd: Path | None = None, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """What it prints and how it ends; raises TimeoutExpired after so many seconds."""
    return subprocess.run(
        [*COMMAND, *words], cwd=cwd, env=env, capture_output=True, text=True, timeout=timeout, check=False
    )


def complaint(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of a command that must end with status 2 and say nothing else."""
    assert main.run(words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("rmc: ")
    return lines[0]
