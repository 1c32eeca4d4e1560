"""Ctrl-C, a killed Redis or evaluator: nothing is left behind; the other faults: tests/faults."""

import sys
from collections.abc import Iterator

import pytest

from tests.integration.running import Training
from tests.processes import alive

ENDLESS = ("--total-steps", "10000000", "--replay-ratio", "8")


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Training]:
    """A run that goes on until it is stopped; the tests below use it in their order."""
    with Training(tmp_path_factory.mktemp("faults") / "run", *ENDLESS) as training:
        training.wait_for_updates()
        yield training


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> None:
    """Not after each of these tests, which share a run: the one of Ctrl-C looks."""


def test_a_killed_evaluator_comes_back(endless: Training) -> None:
    before, restarts = endless.role("evaluator"), endless.newest("launcher", "restarts")
    assert before is not None
    before.kill()
    endless.wait_for(lambda: (now := endless.role("evaluator")) is not None and now.pid != before.pid)
    endless.wait_for(lambda: endless.newest("launcher", "restarts") > restarts)
    evaluations = len(endless.records("evaluator"))
    endless.wait_for(lambda: len(endless.records("evaluator")) > evaluations)


def test_a_killed_redis_comes_back(endless: Training) -> None:
    before = endless.role("redis")
    assert before is not None
    before.kill()
    endless.wait_for(lambda: (now := endless.role("redis")) is not None and now.pid != before.pid)
    steps = endless.newest("replay", "env_steps")
    endless.wait_for_updates(100)
    endless.wait_for(lambda: endless.newest("replay", "env_steps") > steps + 100)


def test_ctrl_c_saves_and_leaves_nothing(endless: Training) -> None:
    processes = endless.launcher.children(recursive=True)
    fork_server = sys.platform == "linux"  # that three roles come from
    assert len(processes) == 5 + fork_server  # four roles and Redis
    sockets = endless.sockets()
    assert sockets
    checkpoints = {path.name for path in (endless.folder / "checkpoints").glob("0*")}
    endless.interrupt()
    assert endless.process.returncode == 130, endless.text()
    assert not alive(processes)
    assert not [path for path in sockets if path.exists()]
    assert {path.name for path in (endless.folder / "checkpoints").glob("0*")} != checkpoints
    assert "stopped at step" in endless.text()
