"""Ctrl-C, kill -9 of each role, a frozen learner: nothing is left behind and the run goes on."""

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.integration.running import Training, alive, run_temporaries

ENDLESS = ("--total-steps", "10000000", "--replay-ratio", "8")


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Training]:
    """A run that goes on until it is stopped; the tests below use it in their order."""
    with Training(tmp_path_factory.mktemp("faults") / "run", *ENDLESS) as training:
        training.wait_for_updates()
        yield training


@pytest.mark.parametrize("name", ["actor", "evaluator", "learner", "replay"])
def test_a_killed_role_comes_back(endless: Training, name: str) -> None:
    before, restarts = endless.role(name), endless.newest("launcher", "restarts")
    assert before is not None
    before.kill()
    endless.wait_for(lambda: (now := endless.role(name)) is not None and now.pid != before.pid)
    endless.wait_for(lambda: endless.newest("launcher", "restarts") > restarts)
    steps = endless.newest("replay", "env_steps")
    endless.wait_for_updates(100)
    endless.wait_for(lambda: endless.newest("replay", "env_steps") > steps + 100)


def test_a_frozen_learner_stops_the_actors_at_their_credit(endless: Training) -> None:
    learner = endless.role("learner")
    assert learner is not None
    learner.suspend()
    try:
        endless.wait_for(lambda: endless.newest("actor-0", "waiting_share") > 0.99)
        endless.wait_for(lambda: endless.newest("actor-0", "waiting_for", "") == "credit")
        steps = endless.newest("replay", "env_steps")
        time.sleep(3.0)
        assert endless.newest("replay", "env_steps") == steps
    finally:
        learner.resume()
    endless.wait_for(lambda: endless.newest("replay", "env_steps") > steps)


def test_a_second_launcher_is_refused(endless: Training) -> None:
    with Training(endless.folder, *ENDLESS) as second:
        assert second.process.wait(60) == 2
    assert "is being trained; stop it first" in endless.text()


def test_ctrl_c_saves_and_leaves_nothing(endless: Training) -> None:
    processes = endless.launcher.children(recursive=True)
    assert len(processes) == 5  # four roles and Redis
    sockets = {path for path in run_temporaries() if any(path.glob("*.sock"))}
    assert sockets
    checkpoints = {path.name for path in (endless.folder / "checkpoints").glob("0*")}
    assert endless.interrupt() < 5.0
    assert endless.process.returncode == 130, endless.text()
    assert not alive(processes)
    assert not {path for path in sockets if path.exists()} - _of_others(processes)
    assert {path.name for path in (endless.folder / "checkpoints").glob("0*")} != checkpoints
    assert "stopped at environment step" in endless.text()


def _of_others(ours: list[psutil.Process]) -> set[Path]:
    """Socket folders of runs that are not ours: their Redis is alive."""
    others = [process for process in psutil.process_iter(["cmdline"]) if process not in ours]
    lines = [" ".join(process.info["cmdline"] or []) for process in others]
    return {path for path in run_temporaries() if any(str(path) in line for line in lines)}


def test_a_killed_launcher_takes_everything_along(tmp_path: Path) -> None:
    with Training(tmp_path / "run", *ENDLESS) as training:
        training.wait_for(lambda: training.role("replay") is not None)
        processes = training.launcher.children(recursive=True)
        before = run_temporaries()
        training.process.send_signal(signal.SIGKILL)
        training.process.wait()
        deadline = time.monotonic() + 5.0
        while alive(processes) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not alive(processes)
    with Training(tmp_path / "run", *ENDLESS) as again:  # and what the kill left is swept
        again.wait_for(lambda: again.role("replay") is not None)
        assert not before - _of_others([]) & run_temporaries()
        again.interrupt()


def test_a_role_that_dies_at_once_ends_the_run_with_its_traceback(tmp_path: Path) -> None:
    environments = tmp_path / "broken_env.py"
    environments.write_text(BROKEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        with Training(tmp_path / "run", "--total-steps", "10000", env="broken_env:Broken-v0") as training:
            assert training.finish(150) == 1
    assert "RuntimeError: the wheel came off" in training.text().splitlines()[-1]
    assert "3 times within 60 s" in training.text()


BROKEN = '''
import gymnasium
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
import sys

class Broken(InvertedPendulumEnv):
    def step(self, action):
        if "actor" in sys.argv:
            raise RuntimeError("the wheel came off")
        return super().step(action)

gymnasium.register("Broken-v0", Broken, max_episode_steps=100)
'''
