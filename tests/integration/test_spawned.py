"""What an environment starts ends with its role, on every way out."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from rmc.common.errors import STOPPED_STATUS
from rmc.common.process.watchdog import HUNG_STATUS
from rmc.deploy.redis.socket_folder import remove_stale
from tests.command import COMMAND
from tests.integration.running import Training
from tests.integration.spawning_env import SPAWNED
from tests.processes import alive
from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere, those of its process group do")
ENDLESS = ("--total-steps", "100000000", "--env-timeout", "3")
SPAWNING = "tests.integration.spawning_env:Spawning-v0"


class Spawner(Training):
    """A run whose environments tell what they started."""

    def simulators(self, pid: int | None = None) -> list[psutil.Process]:
        """Those that run, of one process or of all."""
        notes = self.notes.iterdir() if pid is None else [self.notes / str(pid)]
        pids = [int(word) for path in notes if not path.name.startswith("hang") for word in path.read_text().split()]
        return alive([psutil.Process(one) for one in pids if psutil.pid_exists(one)])

    @property
    def notes(self) -> Path:
        return self.folder.parent / "told"

    def pid_of(self, name: str) -> int:
        """Of a role that plays."""
        self.wait_for(lambda: (role := self.role(name)) is not None and (self.notes / str(role.pid)).exists())
        role = self.role(name)
        assert role is not None
        return role.pid

    def fork_server(self) -> psutil.Process:
        living = alive(self.launcher.children())  # not the daemons that its first evaluation has ended
        return next(one for one in living if "rmc.cli.fork_server" in one.cmdline())


def started(place: Path) -> Spawner:
    """The run there, or the run again."""
    return Spawner(place / "run", *ENDLESS, env=SPAWNING, environment={SPAWNED: str(place / "told")})


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> None:
    """Not after each of these tests, which share two runs: each looks itself."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("spawned")
    (folder / "told").mkdir()
    return folder


@pytest.fixture(scope="module")
def training(place: Path) -> Iterator[Spawner]:
    """A run; the tests below use it and ``again`` in their order."""
    with started(place) as run:
        run.wait_for_updates()
        yield run
        until_ended(run)


@pytest.fixture(scope="module")
def again(place: Path, training: Spawner) -> Iterator[Spawner]:
    """The same run, after its launcher was killed."""
    with started(place) as run:
        yield run
        until_ended(run)


def until_ended(run: Spawner) -> None:
    run.process.kill()
    run.process.wait()
    end_all(run)
    remove_stale(Path(tempfile.gettempdir()))


def end_all(run: Spawner) -> None:
    try:
        wait_until(lambda: not run.simulators(), 5.0, lambda: f"left: {run.simulators()}")
    finally:
        for one in run.simulators():
            one.kill()


def test_those_of_a_group_end_where_the_fork_server_is_killed(training: Spawner) -> None:
    """And the run goes on."""
    players = [psutil.Process(training.pid_of(name)) for name in ("actor", "evaluator")]
    own = training.simulators(players[0].pid)
    training.fork_server().kill()
    training.wait_for(lambda: not alive(own[:1]), 5.0)
    training.wait_for(lambda: not alive(players))
    for left in [one for player in players for one in training.simulators(player.pid)]:  # these have left the group
        left.kill()
    training.pid_of("actor")


def test_everything_ends_where_the_launcher_is_killed(training: Spawner, request: pytest.FixtureRequest) -> None:
    """And what that leaves is swept by the next start."""
    training.pid_of("actor")
    assert training.simulators()
    fork_server, processes = training.fork_server(), training.launcher.children(recursive=True)
    sockets = training.sockets()
    training.process.send_signal(signal.SIGKILL)
    training.process.wait()
    end_all(training)
    fork_server.wait(5.0)  # which has ended them
    assert psutil.wait_procs(processes, 5.0)[1] == []
    assert [path for path in sockets if path.exists()]
    again = request.getfixturevalue("again")
    again.wait_for(lambda: again.role("replay") is not None)
    assert not [path for path in sockets if path.exists()]


def test_they_end_with_a_role_that_is_killed_or_hangs_and_with_the_run(again: Spawner) -> None:
    actor, evaluator = again.pid_of("actor"), again.pid_of("evaluator")
    theirs = len(again.simulators(evaluator))
    assert len(again.simulators(actor)) >= 3
    psutil.Process(actor).kill()
    again.wait_for(lambda: not again.simulators(actor), 5.0)
    assert len(again.simulators(evaluator)) == theirs >= 3  # which plays on

    again.wait_for(lambda: (role := again.role("actor")) is not None and role.pid != actor)
    new = again.pid_of("actor")
    (again.notes / f"hang-{new}").touch()
    again.wait_for(lambda: not psutil.pid_exists(new), 20.0)
    again.wait_for(lambda: not again.simulators(new), 5.0)

    again.pid_of("actor")
    again.interrupt()
    assert again.simulators() == []


def checked(tmp_path: Path, *words: str) -> tuple[subprocess.Popen[bytes], list[psutil.Process]]:
    """A command that plays without end, and what its environment has started."""
    command = [*COMMAND, "check-env", SPAWNING, "--steps", "1000000", *words]
    process = subprocess.Popen(command, env={**os.environ, SPAWNED: str(tmp_path)}, stderr=subprocess.DEVNULL)
    note = tmp_path / str(process.pid)
    wait_until(lambda: note.exists() or process.poll() is not None, 60.0)
    assert process.poll() is None
    theirs = alive([psutil.Process(int(pid)) for pid in note.read_text().split()])
    assert len(theirs) == 3
    return process, theirs


def test_they_end_with_a_command_in_which_a_call_hangs(tmp_path: Path) -> None:
    process, theirs = checked(tmp_path, "--env-timeout", "1")
    (tmp_path / f"hang-{process.pid}").touch()
    assert process.wait(60.0) == HUNG_STATUS
    assert alive(theirs) == []


def test_they_end_with_a_command_that_is_told_to(tmp_path: Path) -> None:
    process, theirs = checked(tmp_path)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60.0) == STOPPED_STATUS
    assert alive(theirs) == []
