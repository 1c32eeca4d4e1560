"""Folders that vanish while a run is trained."""

import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from tests.integration.running import Training
from tests.processes import alive
from tests.raising import raising


@pytest.mark.long
def test_a_temporary_folder_that_vanishes_is_made_again(tmp_path: Path) -> None:
    """Roles that die later find Redis, the learner finds the replay server, and the run has its result."""
    with Training(tmp_path / "run", "--total-steps", "12000") as training:
        training.wait_for_updates()
        (folder,) = (path for path in training.sockets() if path.is_dir())
        shutil.rmtree(folder)
        training.wait_for(lambda: (folder / "redis.sock").exists() and (folder / "replay.sock").exists(), 30.0)
        actor = training.role("actor")
        assert actor is not None
        actor.kill()
        training.wait_for_updates(20)
        (folder / "replay.sock").unlink()
        training.wait_for(lambda: (folder / "replay.sock").exists(), 30.0)
        training.wait_for_updates(20)
        assert training.finish(120) == 0, training.text()
    assert (training.folder / "result.json").exists()
    assert "was removed; it is made again" in training.text()


def deleted(folder: Path) -> None:
    while folder.exists():  # a role may write there meanwhile
        shutil.rmtree(folder, ignore_errors=True)


def replaced(folder: Path) -> None:
    folder.rename(folder.with_name("elsewhere"))
    shutil.copytree(folder.with_name("elsewhere"), folder)


def emptied(folder: Path) -> None:
    subprocess.run(f"rm -rf {folder}/*", shell=True, check=True)


@pytest.mark.parametrize("vanish", [deleted, replaced, emptied])
def test_each_way_is_seen(vanish: Callable[[Path], None], tmp_path: Path) -> None:
    folder = open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(tmp_path / "run", "fail"))
    assert folder.secret()
    folder.lock.check_there()
    vanish(folder.path)
    with pytest.raises(ConfigError, match="was deleted or moved while it was trained"):
        folder.lock.check_there()
    folder.lock.release()


@pytest.mark.parametrize("number", [errno.EACCES, errno.ESTALE, errno.EIO, errno.ENOTCONN])
def test_a_network_disk_that_is_away_for_a_moment_is_no_folder_gone(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(tmp_path / "run", "fail"))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", raising(OSError(number, os.strerror(number))))
        folder.lock.check_there()
    folder.lock.release()


@pytest.mark.parametrize(
    "vanish", [deleted, *(pytest.param(one, marks=pytest.mark.long) for one in (replaced, emptied))]
)
def test_a_runs_folder_that_vanishes_ends_it_in_one_line(vanish: Callable[[Path], None], tmp_path: Path) -> None:
    """Also where a role dies before that is noticed."""
    with Training(tmp_path / "run", "--total-steps", "100000000") as training:
        training.wait_for_updates()
        processes, actor = training.launcher.children(recursive=True), training.role("actor")
        assert actor is not None
        vanish(training.folder)
        actor.kill()
        assert training.finish(30) == 2
        assert not alive(processes)
    last = training.text().splitlines()[-1]
    assert last.startswith(f"rmc: --run-dir='{training.folder}': was deleted or moved while it was trained")
    assert "Traceback" not in training.text()
    assert vanish is not deleted or not training.folder.exists()
