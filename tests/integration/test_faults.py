"""Ctrl-C, a killed Redis or evaluator: nothing is left behind, no secret shown; the other faults: tests/faults."""

import sys
from collections.abc import Iterator

import pytest

from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run.folder import RunFolder
from tests.integration.running import Training
from tests.integration.watched import Watched, check_all_was_searched, holding
from tests.processes import alive

ENDLESS = ("--total-steps", "10000000", "--replay-ratio", "8")


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Watched]:
    """A run that goes on until it is stopped; the tests below use it in their order."""
    with Watched(tmp_path_factory.mktemp("faults") / "run", *ENDLESS) as training:
        training.go_on(1)
        yield training


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> None:
    """Not after each of these tests, which share a run: the one of Ctrl-C looks."""


def evaluations_of(run: Training) -> int:
    """So far; what else the evaluator says, it says each second."""
    return sum("eval_update" in record for record in run.records("evaluator"))


def test_a_killed_evaluator_comes_back(endless: Watched) -> None:
    before, restarts = endless.role("evaluator"), endless.newest("launcher", "restarts")
    assert before is not None
    before.kill()
    endless.wait_for(lambda: (now := endless.role("evaluator")) is not None and now.pid != before.pid)
    endless.wait_for(lambda: endless.newest("launcher", "restarts") > restarts)
    evaluations = evaluations_of(endless)
    endless.wait_for(lambda: evaluations_of(endless) > evaluations)


def test_a_killed_redis_comes_back(endless: Watched) -> None:
    before = endless.role("redis")
    assert before is not None
    endless.lose_redis()
    endless.wait_for(lambda: (now := endless.role("redis")) is not None and now.pid != before.pid)
    steps = endless.newest("replay", "env_steps")
    endless.wait_for_updates(100)
    endless.wait_for(lambda: endless.newest("replay", "env_steps") > steps + 100)


def test_ctrl_c_saves_and_leaves_nothing(endless: Watched) -> None:
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


def test_passwords_and_secret_of_an_embedded_redis_are_nowhere(endless: Watched) -> None:
    """Nor after it was killed, of which all roles tell; the secret stands in its own file."""
    run = RunFolder(endless.folder)
    users = RedisUsers(run.name, run.secret(), run.config().roles())
    passwords = {users.password(user).encode() for user in (LAUNCHER, *users.roles)}
    left = endless.left()
    check_all_was_searched(left, endless.folder)
    assert any(name.endswith("users.acl") for name in left)
    assert holding(left, passwords) == set()
    assert holding(left, {run.secret()}) == {str(run.secret_file)}
