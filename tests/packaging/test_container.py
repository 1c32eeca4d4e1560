"""What a container gives: an unknown user, a read-only root, little shared memory, no network, no home."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.package import FOLDERS, ROOT
from tests.packaging.container import Image, kept, steps

DOCKERFILE = (ROOT / "Dockerfile").read_text()
STRANGER = 4242  # a user number that no system file names
FOLDER = "/mnt"
TRAIN = "train InvertedPendulum-v5 --preset debug --total-steps 600 --run-dir run --episodes 1"
UNSHARE = ["unshare", "--mount", "--pid", "--fork", "--net", "true"]
MAY_MOUNT = os.geteuid() == 0 and bool(shutil.which("unshare")) and subprocess.run(UNSHARE, check=False).returncode == 0
CHROOT = pytest.mark.skipif(not MAY_MOUNT, reason="wants root that may mount, and unshare of util-linux")


def test_the_image_gets_what_the_package_is_made_of() -> None:
    assert kept(ROOT) == {*FOLDERS, "Dockerfile", "constraints.txt", "pyproject.toml", "README.md", "LICENSE"}
    assert all((ROOT / name).exists() for name in kept(ROOT))


def test_the_image_is_the_tested_torch_on_a_supported_python_without_root() -> None:
    done = steps(DOCKERFILE)
    (torch,) = re.findall(r"torch==([\d.]+)", DOCKERFILE)
    assert f"torch=={torch}" in (ROOT / "constraints.txt").read_text().splitlines()
    assert done[0] == ("FROM", "python:3.11-slim")
    assert [text for instruction, text in done if instruction == "USER"] == ["rmc"]
    assert done[-1] == ("ENTRYPOINT", '["rmc"]')
    assert done.index(("USER", "rmc")) > max(
        index for index, (instruction, _) in enumerate(done) if instruction == "RUN"
    )


def test_lines_that_go_on_are_one_step() -> None:
    assert steps("# no\nFROM a\n\nRUN one \\\n    && two\n") == [("FROM", "a"), ("RUN", "one && two")]


@CHROOT
def test_it_trains_where_next_to_nothing_is_allowed(tmp_path: Path) -> None:
    """With every process, socket and shared batch of a run, in the checkout's own environment."""
    root, work = tmp_path / "root", tmp_path / "work"
    for path in (root, work):
        path.mkdir()
    os.chown(work, STRANGER, STRANGER)
    image = Image(root, ROOT, folder=FOLDER, bound=_needed())
    for path in [*image.bound, Path(FOLDER), Path("/proc"), Path("/dev")]:
        (root / path.relative_to("/")).mkdir(parents=True, exist_ok=True)
    image.entrypoint = [sys.executable, "-m", "rmc.cli.main"]
    trained = image.run(TRAIN.split(), work, STRANGER)
    assert (trained.returncode, trained.stderr) == (0, ""), trained.stdout + trained.stderr
    assert json.loads((work / "run" / "result.json").read_bytes())["env_steps"] >= 600
    evaluated = image.run(["evaluate", "run", "--episodes", "1"], work, STRANGER)
    assert (evaluated.returncode, evaluated.stderr) == (0, ""), evaluated.stderr
    assert [path.name for path in work.iterdir()] == ["run"]  # no caches, no sockets beside the run


def _needed() -> list[Path]:
    """What Python and the package need of this machine, without what is inside of another."""
    system = [Path(name) for name in ("/usr", "/bin", "/lib", "/lib64", "/etc")]
    own = [ROOT, Path(sys.prefix), Path(sys.base_prefix), *(Path(name) for name in sys.path if Path(name).is_dir())]
    there = {path for path in [*system, *own] if path.is_absolute() and path.is_dir()}
    return sorted(path for path in there if not there.intersection(path.parents))
