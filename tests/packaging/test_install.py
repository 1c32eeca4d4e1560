"""Installed as a wheel or from a checkout, nothing of a user's own shadows the package, nor the other way round."""

import os
import shutil
import site
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from tests.package import FOLDERS, ROOT

LIBRARIES = site.getsitepackages()[0]  # what the package needs; its own editable install is not taken along
ENVIRONMENT = """
import gymnasium as gym
import numpy as np
from common.errors import REWARD


class Mine(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), REWARD, False, False, {}


gym.register("Mine-v0", Mine, max_episode_steps=20)
"""
TRAIN = (
    "train mine:Mine-v0 --launcher lockstep --preset debug --total-steps 200 --warmup-steps 100 --capacity 200 "
    "--run-dir run"
)
POLICY = """
from rmc import load_policy
import learner, common.errors, rmc.common.errors
print(load_policy("run").act([0.0, 0.0]).shape, rmc.common.errors.__file__)
"""


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout; of what was built in it, numba's code alone comes along."""
    copy = tmp_path_factory.mktemp("sources")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("*.pyc"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return copy


@pytest.fixture(scope="module", params=["wheel", pytest.param("editable", marks=pytest.mark.long)])
def binaries(request: pytest.FixtureRequest, sources: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of a fresh environment that the package is installed into."""
    folder = tmp_path_factory.mktemp(request.param)
    venv.create(folder, symlinks=True, with_pip=False)
    (packages,) = (folder / "lib").glob("python*/site-packages")
    (packages / "libraries.pth").write_text(LIBRARIES + "\n")
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python"), "--disable-pip-version-check"]
    install = [*pip, "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--force-reinstall"]
    if request.param == "wheel":
        _run([*pip[:3], "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder), str(sources)], ROOT)
        (wheel,) = folder.glob("rmc_rl-*.whl")
        names = zipfile.ZipFile(wheel).namelist()
        assert {name.split("/")[0] for name in names if ".dist-info" not in name} == {"rmc"}
        assert {
            "rmc/deploy/cluster/aws.yaml",
            "rmc/deploy/monitor/alerts.yaml",
            "rmc/deploy/monitor/dashboard.json",
            "rmc/py.typed",
            "rmc/analysis/report.html",
            "rmc/analysis/watch.html",
            "rmc/common/bus/redis_bus.py",
        } <= set(names)
        _run([*install, "--prefix", str(folder), str(wheel)], ROOT)
    else:
        _run([*install, "--prefix", str(folder), "-e", str(sources)], ROOT)
    return folder / "bin"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A user's folder, with files that are called as the package's own folders are."""
    for folder in ("common", "actors", "deploy"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "__init__.py").write_text("")
    (tmp_path / "common" / "errors.py").write_text("REWARD = 1.0\n")
    (tmp_path / "learner.py").write_text("MINE = True\n")
    (tmp_path / "mine.py").write_text(ENVIRONMENT)
    return tmp_path


def _run(words: list[str], folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_folder_with_the_packages_names_is_no_hindrance(binaries: Path, project: Path) -> None:
    rmc, python = str(binaries / "rmc"), str(binaries / "python")
    assert "check-env" in _run([rmc, "--help"], project)
    assert "after training:  return 20.0" in _run([rmc, *TRAIN.split()], project)
    shape, path = _run([python, "-c", POLICY], project).split(" ")
    assert shape == "(1,)"
    where = Path(path.strip())
    assert where.is_relative_to(binaries.parent) or where.parents[1].name.startswith("sources")
