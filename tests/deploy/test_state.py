"""What became of a run is told from its folder alone."""

import json
from pathlib import Path

import pytest

from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug
from rmc.deploy.run.state import run_state
from tests.command import complaint

RESULT = ("env_steps", "updates", "wall_s", "eval_return_mean", "eval_return_std", "eval_episodes")


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    return open_run(debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(tmp_path / "run", "fail"))


def test_a_run_is_trained_until_it_ends(folder: RunFolder) -> None:
    assert run_state(folder) == "training"
    folder.lock.release(130)
    assert run_state(folder) == "stopped"


@pytest.mark.parametrize("status", [1, 2])
def test_any_other_end_is_a_failure(folder: RunFolder, status: int) -> None:
    folder.lock.release(status)
    assert run_state(folder) == "failed"


@pytest.mark.parametrize("command", ["evaluate", "doctor", "plot"])
@pytest.mark.parametrize(
    ("status", "says"), [(1, "; it failed, and logs/launcher.log says why"), (130, "; train it for longer")]
)
def test_a_run_with_too_little_on_record_comes_with_what_helps(
    folder: RunFolder, status: int, says: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder.logs / "launcher.log").touch()
    folder.lock.release(status)
    line = complaint([command, str(folder.path)], capsys)
    assert line.startswith(f"rmc: RUN{'S' * (command == 'plot')}='{folder.path}': it has ")
    assert line.endswith(says)


def test_a_run_with_a_result_is_finished(folder: RunFolder) -> None:
    folder.write_result(dict.fromkeys((*RESULT, "initial_return_mean"), 1.0))
    assert run_state(folder) == "training"
    folder.lock.release(0)
    assert run_state(folder) == "finished"


def test_one_whose_launcher_was_killed_is_lost(folder: RunFolder) -> None:
    lock = folder.path / ".lock"
    text = lock.read_text()
    folder.lock.release()
    lock.write_text(text)
    assert run_state(folder) == "lost"


def test_one_that_nobody_has_trained_is_new(folder: RunFolder) -> None:
    folder.lock.release()
    assert run_state(folder) == "new"
    folder.metrics.write_text(json.dumps({"role": "learner"}) + "\n")
    assert run_state(folder) == "stopped"  # as runs of earlier versions noted it
