"""Ends that are told: of a role that dies again and again, amid an evaluation, of a tracker."""

import time
from pathlib import Path

import pytest

from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.local.supervisor import STOP_SECONDS
from rmc.deploy.run.folder import RunFolder
from tests import wandb_file
from tests.integration.running import Training
from tests.processes import alive


@pytest.mark.long
def test_a_temporary_folder_with_a_long_and_odd_name_is_no_fault(tmp_path: Path) -> None:
    """Sockets lie in it, or in another one where their paths do not fit."""
    odd = tmp_path / f'a#b?c%d e"f\\g{"x" * 60}'
    odd.mkdir()
    with Training(tmp_path / "run", environment={"TMPDIR": str(odd)}) as training:
        assert training.finish(150) == 0, training.text()
    assert (tmp_path / "run" / "result.json").exists()


def test_a_role_that_dies_at_once_ends_the_run_with_its_traceback(tmp_path: Path) -> None:
    environments = tmp_path / "broken_env.py"
    environments.write_text(BROKEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        with Training(tmp_path / "run", "--total-steps", "10000", env="broken_env:Broken-v0") as training:
            assert training.finish(150) == 1
    assert "RuntimeError: the wheel came off" in training.text().splitlines()[-1]
    assert "3 times in a row" in training.text()


def test_a_learner_that_a_replay_server_holds_is_given_the_time_to_save(tmp_path: Path) -> None:
    """It hears of the end only after 10 s, and has no checkpoint yet."""
    options = ("--total-steps", "10000000", "--checkpoint-steps", "10000000")
    with Training(tmp_path / "run", *options) as training:
        training.wait_for_updates(20)
        replay = training.role("replay")
        assert replay is not None
        replay.suspend()
        time.sleep(1.0)  # until it draws
        updates = training.newest("learner", "updates")
        assert training.interrupt() > 2 * STOP_SECONDS  # a replay server alone that does not end is killed earlier
    assert CheckpointFolder(tmp_path / "run" / "checkpoints").numbers()[-1] >= updates


@pytest.mark.parametrize("when", ["before", pytest.param("after", marks=pytest.mark.long)])
def test_who_stops_it_amid_its_first_or_last_evaluation_is_told_how_to_go_on(when: str, tmp_path: Path) -> None:
    """Ten episodes of 50 steps take 5 s."""
    steps = ("--total-steps", "400", "--warmup-steps", "100", "--episodes", "0")
    with Training(tmp_path / "run", *steps, env="tests.slow_env:Slow-v0") as training:
        if when == "before":
            training.wait_for(lambda: "run folder" in training.text())
        else:
            training.wait_for(lambda: training.newest("learner", "finished") and not training.sockets())
            time.sleep(1.0)
        training.interrupt()
        assert training.process.returncode == 130
    steps_made = 400 * (when == "after")
    how = f"stopped at step {steps_made}; to go on:\n  rmc resume {tmp_path / 'run'}\n"
    assert how in training.text()
    assert RunFolder(tmp_path / "run").lock.ended() == 130


BROKEN = """
import gymnasium
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
import sys

class Broken(InvertedPendulumEnv):
    def step(self, action):
        if "actor" in sys.argv:
            raise RuntimeError("the wheel came off")
        return super().step(action)

gymnasium.register("Broken-v0", Broken, max_episode_steps=100)
"""


@pytest.mark.long  # docs/trackers.md's commands run in tests/docs/test_watching.py
def test_a_tracked_run_ends_with_its_tracker(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    offline = {"WANDB_MODE": "offline"}
    with Training(folder, "--total-steps", "10000000", "--track", "wandb", environment=offline) as training:
        training.wait_for_updates()
        training.wait_for(lambda: list(folder.glob("wandb/offline-run-*/*.wandb")))
        processes = training.launcher.children(recursive=True)
        assert any("tracker_process" in " ".join(process.cmdline()) for process in processes)
        took = training.interrupt()
        assert training.process.returncode == 130
        assert took < 15.0
        assert not alive(processes)
    (records,) = wandb_file.records(folder)
    assert wandb_file.exit_codes(records) == [0]
    assert wandb_file.summary(records)["state"] == "stopped"
    assert "WARNING" not in training.text()
