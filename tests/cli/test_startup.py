"""What a command imports before it has anything to do: a user waits for it, and every role's memory holds it."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import sys
from rmc.cli import main

status = main.run(sys.argv[1:])
print("IMPORTED", *(name for name in ("torch", "numba", "tyro") if name in sys.modules))
sys.exit(status)
"""


def rmc(at: Path, *words: str) -> tuple[subprocess.CompletedProcess[str], set[str]]:
    """A command, and which of the slow libraries it imported."""
    command = [sys.executable, "-c", PROGRAM, *words]
    done = subprocess.run(command, cwd=at, capture_output=True, text=True, timeout=60, check=False)
    output, marker, imported = done.stdout.rpartition("IMPORTED")
    assert marker, done.stderr
    done.stdout = output
    return done, set(imported.split())


def test_help_imports_no_torch(tmp_path: Path) -> None:
    done, imported = rmc(tmp_path, "--help")
    assert done.returncode == 0, done.stderr
    assert "check-env" in done.stdout
    assert imported == {"tyro"}


def test_checking_an_environment_imports_no_torch(tmp_path: Path) -> None:
    done, imported = rmc(tmp_path, "check-env", "Pendulum-v1", "--steps", "10")
    assert (done.returncode, done.stderr) == (0, "")
    assert imported == {"tyro"}


@pytest.mark.parametrize("words", [["train", "--batch-size", "0"], ["sweep", "--grid", "batch_size=1,0"]])
def test_a_refused_option_imports_no_torch(words: list[str], tmp_path: Path) -> None:
    done, imported = rmc(tmp_path, words[0], "HalfCheetah-v5", *words[1:])
    assert done.returncode == 2
    assert "--batch-size=0" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "torch" not in imported


def test_the_version_imports_nothing(tmp_path: Path) -> None:
    done, imported = rmc(tmp_path, "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, "rmc 0.1.0\n", "")
    assert imported == set()


@pytest.mark.parametrize(
    "module",
    ["rmc.deploy.local.replay_process", "rmc.deploy.run.folder", "rmc.cli.analysis_commands", "rmc.analysis.rendering"],
)
def test_what_needs_no_network_imports_no_torch(module: str, tmp_path: Path) -> None:
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
