"""The README stays true: its commands run, its file tree is the repository's."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
PACKAGES = ("common", "actors", "replay_server", "learner", "deploy")


def test_its_tree_names_every_file() -> None:
    block = README[README.index("## What is where") :]
    found, folder = set(), ""
    for row in block.splitlines():
        top, leaf = re.match(r"(\w+)/", row), re.match(r"[├└]── (\w+\.py)", row)
        folder = top[1] if top else folder
        if leaf:
            found.add(f"{folder}/{leaf[1]}")
    there = {f"{package}/{path.name}" for package in PACKAGES for path in (ROOT / package).glob("*.py")}
    assert found == {path for path in there if not path.endswith("__init__.py")}


def test_its_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    targets = re.findall(r"make (\w+)", README)
    assert {"demo", "test", "env"} <= set(targets)
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)


@pytest.mark.timeout(300)
def test_its_commands_run(tmp_path: Path) -> None:
    commands = re.findall(r"```sh\n(rmc .*)\n```", README)
    assert [command.split()[1] for command in commands] == ["train", "evaluate", "stats"]
    for command in commands:
        words = [sys.executable, "-m", "deploy.cli", *command.split()[1:]]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=280)
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stderr == ""
        assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
