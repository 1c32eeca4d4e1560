"""A role's host on Ray, without a cluster: what it does when its role ends or is ended."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

pytest.importorskip("ray")

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import CheckpointError, RmcError
from rmc.deploy.local import supervisor
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.ray import launcher_actor, learner_actor, role_actor
from rmc.deploy.ray.launcher_actor import LauncherActor
from rmc.deploy.ray.learner_actor import LearnerActor
from rmc.deploy.ray.role_actor import RoleActor, Task
from tests.processes import alive
from tests.raising import raising
from tests.waiting import wait_until

PYTHON = sys.executable


@pytest.fixture(autouse=True)
def _own_process(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A host changes its process's folder and variables: both are as before after the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(role_actor.descendants, "adopt_orphans", lambda: None)
    monkeypatch.setenv("OMP_NUM_THREADS", os.environ.get("OMP_NUM_THREADS", "1"))


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """With what status hosts have ended themselves."""
    pids: list[int] = []
    monkeypatch.setattr(role_actor.os, "_exit", pids.append)
    monkeypatch.setattr(role_actor, "LAST_WORDS_SECONDS", 0.0)
    return pids


ENDS = "#!/bin/sh\ntrap 'exit 0' TERM\nwhile :; do sleep 0.05; done\n"


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """In a role's place: it ends cleanly when it is told to."""
    path = tmp_path / "program"
    path.write_text(ENDS)
    path.chmod(0o700)
    monkeypatch.setattr(supervisor.sys, "executable", str(path))
    return path


@pytest.fixture
def host(program: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[RoleActor]:
    """Its watcher is slow to see an end."""
    assert program.exists()
    reap = supervisor.RoleProcess.reap

    def slow_for_watchers(role: supervisor.RoleProcess, timeout: float) -> bool:
        ended = reap(role, timeout)
        if threading.current_thread() is not threading.main_thread():
            time.sleep(0.3)
        return ended

    monkeypatch.setattr(supervisor.RoleProcess, "reap", slow_for_watchers)
    actor = RoleActor(Task("test-run", RoleCommand("replay", ("replay",)), {}, {}, str(tmp_path)))
    yield actor
    actor.close()
    shutil.rmtree(actor.scratch)


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_role_that_is_replaced_does_not_end_its_host(host: RoleActor, ends: list[int]) -> None:
    before, watcher = host.report("", 0).pid, host._watcher
    host.restart()
    after = host.report("", 0)
    assert after.pid not in (None, before)
    watcher.join(10.0)  # though slow, it sees the end of the first
    assert (watcher.is_alive(), ends) == (False, [])  # nor does the new one, which is watched, too:
    assert after.pid is not None
    os.kill(after.pid, 9)
    wait_until(lambda: ends)
    assert ends == [1]


def test_a_role_that_is_replaced_has_its_secrets_again(program: Path, tmp_path: Path) -> None:
    """Though a cleaner of temporary files has taken them."""
    assert program.exists()
    actor = RoleActor(Task("run", RoleCommand("replay", ("replay",)), {}, {"secret": b"of the run"}, str(tmp_path)))
    (actor.scratch / "secret").unlink()
    actor.restart()
    assert (actor.scratch / "secret").read_text() == "of the run"
    actor.close()
    shutil.rmtree(actor.scratch)


HOST = """
import subprocess, sys, time
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.ray.role_actor import RoleActor, Task
print(subprocess.Popen(["sleep", "60"], stdout=subprocess.DEVNULL).pid, flush=True)
sys.executable = sys.argv[1]
host = RoleActor(Task("run", RoleCommand("actor-0", ("actor",)), {}, {}, "."))
time.sleep(60)
"""
STRAYS = """#!/bin/sh
setsid sleep 60 &
echo $$ $! > written
mv written pids
wait
"""


def test_what_an_environment_started_ends_with_a_role_that_is_killed(program: Path, tmp_path: Path) -> None:
    """Also in a session of its own; what Ray has started in the host's process does not."""
    program.write_text(STRAYS)
    words = [PYTHON, "-c", HOST, str(program)]
    with subprocess.Popen(words, env=os.environ | {"TMPDIR": str(tmp_path)}, stdout=subprocess.PIPE) as host:
        assert host.stdout is not None
        rays = psutil.Process(int(host.stdout.readline()))
        wait_until((tmp_path / "pids").exists)
        role, stray = map(psutil.Process, map(int, (tmp_path / "pids").read_text().split()))
        role.kill()
        assert host.wait(30) == 1  # for Ray to start both again
        assert (alive([stray]), alive([rays])) == ([], [rays])
        rays.kill()


@pytest.mark.parametrize(
    "error", [OSError(errno.EAGAIN, os.strerror(errno.EAGAIN)), RuntimeError("can't start new thread")]
)
def test_a_host_that_can_start_no_process_ends_itself(
    error: Exception, host: RoleActor, ends: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host._role, "start", raising(error))
    host.restart()
    assert ends == [1]


class Learner(LearnerActor):
    """With a folder, and no launcher that it would bring checkpoints to."""

    def prepare(self) -> None:
        self._folder = CheckpointFolder(self.scratch / "checkpoints")
        self._folder.folder.mkdir()
        self._folder.note_save(2.0)

    def flush_artifacts(self) -> None:
        pass

    def tend(self) -> None:
        pass


def test_a_launcher_that_still_imports_when_it_is_to_end_is_not_started_again(tmp_path: Path) -> None:
    launcher = LauncherActor.__new__(LauncherActor)
    launcher._folder, launcher._checkpoints, launcher._asked_to_end = tmp_path, CheckpointFolder(tmp_path), False
    launcher._status = None
    with subprocess.Popen(["sleep", "60"]) as role:
        launcher._role = role  # type: ignore[assignment]
        assert not launcher.is_final_exit(-signal.SIGKILL)
        launcher.end()
        assert launcher.is_final_exit(role.wait(10))
    launcher._status, launcher._asked_to_end = -signal.SIGKILL, False
    with pytest.raises(RmcError, match="is started again"):  # and asked again: the next one hears it
        launcher.end()
    assert not launcher._asked_to_end


def test_a_learner_that_saves_for_long_is_not_killed(
    program: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log = tmp_path / "said"
    ends = ENDS.replace("exit 0", f"sleep 1.5; echo saved >> {log}; exit 0")
    program.write_text(ends.replace("while", f"echo ready > {log}\nwhile"))
    monkeypatch.setattr(learner_actor, "HELD_SECONDS", 0.5)
    host = Learner(Task("test-run", RoleCommand("learner", ("learner",)), {}, {}, str(tmp_path)))
    wait_until(log.exists)
    host.close()
    shutil.rmtree(host.scratch)
    assert log.read_text() == "ready\nsaved\n"


def test_a_damaged_checkpoint_holds_no_newer_one_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learner, brought = LearnerActor.__new__(LearnerActor), list[int]()
    learner._folder, learner._archived, learner._epoch, learner._incarnation = CheckpointFolder(tmp_path), -1, 0, ""
    for number in (1, 2):
        learner._folder.save(number, {"state": b"whole"})
    (learner._folder.path(1) / "state").write_bytes(b"whale")
    archive = SimpleNamespace(remote=lambda _, number, *rest: brought.append(number))
    monkeypatch.setattr(learner, "_launcher", lambda: SimpleNamespace(archive=archive))
    monkeypatch.setattr(learner_actor.ray, "get", lambda reply: reply)
    learner._bring()
    assert brought == [2]
    learner._folder.save(3, {"state": b"whole"})
    (learner._folder.path(3) / "state").write_bytes(b"whale")
    with pytest.raises(CheckpointError):  # the newest is tried again, and what is left is told
        learner._bring()


@pytest.mark.parametrize(("again", "statuses"), [(True, [1]), (False, [])])
def test_a_launchers_host_that_can_start_no_process_is_tried_again_where_ray_has_started_it_again(
    again: bool, statuses: list[int], ends: list[int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(RoleActor, "__init__", raising(OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))))
    context = SimpleNamespace(was_current_actor_reconstructed=again)
    monkeypatch.setattr(launcher_actor.ray, "get_runtime_context", lambda: context)
    with pytest.raises(BlockingIOError):  # its creator hears of it
        LauncherActor(Task("r", RoleCommand("launcher", ()), {}, {}, ""), str(tmp_path), 1)
    assert ends == statuses


@pytest.mark.parametrize("was_here", [True, False])
def test_a_learners_own_checkpoints_outlive_a_start_of_ray_on_its_machine(
    was_here: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray's id of a node is another then, its address is not."""
    head = LauncherActor.__new__(LauncherActor)
    head._claim, head._checkpoints = tmp_path / "learner-at", CheckpointFolder(tmp_path / "head")
    head.claim("before", "10.0.0.2" if was_here else "10.0.0.3")
    learner, asks = LearnerActor.__new__(LearnerActor), ("claim", "newest")
    learner.scratch, learner._incarnation = tmp_path, "now"
    CheckpointFolder(tmp_path / "checkpoints").save(7, {"state": b"whole"})
    remote = SimpleNamespace(**{name: SimpleNamespace(remote=getattr(head, name)) for name in asks})
    monkeypatch.setattr(learner, "_launcher", lambda: remote)
    monkeypatch.setattr(learner_actor.ray, "get", lambda reply: reply)
    monkeypatch.setattr(learner_actor.ray.util, "get_node_ip_address", lambda: "10.0.0.2")
    monkeypatch.setattr(
        learner_actor.ray, "get_runtime_context", lambda: SimpleNamespace(get_node_id=lambda: os.urandom(8).hex())
    )
    learner.prepare()
    assert learner._folder.numbers() == ([7] if was_here else [])


def test_an_end_in_order_that_nobody_asked_for_is_a_death(
    program: Path, ends: list[int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program.write_text("#!/bin/sh\nexit 0\n")
    host = RoleActor(Task("test-run", RoleCommand("actor-0", ("actor",)), {}, {}, str(tmp_path)))
    wait_until(lambda: ends)
    assert host.report("", 0).status == 1
    shutil.rmtree(host.scratch)


def test_what_a_launcher_leaves_is_ended_but_no_other_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    names = ["r:learner", "r:replay-0", "r:replay-1", "other:replay-0"]
    monkeypatch.setattr(launcher_actor, "actor_name", lambda run, role: f"{run}:{role}")
    table = {name: {"name": name, "state": "CREATED"} for name in names} | {"": {"name": "r:x", "state": "REMOVED"}}
    removed, ray, done = list[str](), launcher_actor.ray, list[str]()
    hosts = {name: SimpleNamespace(close=SimpleNamespace(remote=partial(str, f"close {name}"))) for name in names}
    named = [{"name": name, "namespace": role_actor.NAMESPACE} for name in (*names, "r:launcher")]
    named.append({"name": "r:evaluator", "namespace": "theirs"})
    monkeypatch.setattr(launcher_actor, "placement_group_table", lambda: table)
    monkeypatch.setattr(launcher_actor, "remove_placement_group", removed.append)
    monkeypatch.setattr(ray.util, "get_placement_group", lambda name: name)
    monkeypatch.setattr(ray.util, "list_named_actors", lambda all_namespaces: named)
    monkeypatch.setattr(ray, "get_actor", lambda name, _: hosts[name])
    monkeypatch.setattr(ray, "get_runtime_context", lambda: SimpleNamespace(current_actor="launcher"))
    monkeypatch.setattr(ray, "wait", lambda replies, **_: done.extend(replies))
    kill = {id(host): f"kill {name}" for name, host in hosts.items()}
    monkeypatch.setattr(ray, "kill", lambda host, **_: done.append(kill.get(id(host), f"kill {host}")))
    launcher = LauncherActor.__new__(LauncherActor)
    launcher._task, launcher._checkpoints = (
        Task("r", RoleCommand("launcher", ()), {}, {}, ""),
        CheckpointFolder(tmp_path),
    )
    launcher.flush_artifacts()
    assert removed == names[:3]
    assert done == [*(f"close {name}" for name in names[:3]), *(f"kill {name}" for name in names[:3]), "kill launcher"]
    monkeypatch.setattr(ray, "wait", lambda *_, **__: 1 / 0)
    done.clear()
    with pytest.raises(ZeroDivisionError):
        launcher.flush_artifacts()
    assert done == ["kill launcher"]  # it would hold the run's name


NO_ROOM, READ_ONLY = (OSError(number, os.strerror(number)) for number in (errno.ENOSPC, errno.EROFS))
NO_LAUNCHER, AWAY = ValueError("no such actor"), launcher_actor.ray.exceptions.RayActorError()


@pytest.mark.parametrize("error", [NO_ROOM, READ_ONLY, NO_LAUNCHER, AWAY])
def test_a_head_that_takes_no_file_is_waited_for_unless_the_run_is_ended(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = LearnerActor.__new__(LearnerActor)
    learner._run_ends = learner._replaced = False
    tries: list[float] = []

    def tend() -> None:
        tries.append(time.monotonic())
        if len(tries) < 6:
            raise error

    monkeypatch.setattr(learner, "tend", tend)
    monkeypatch.setattr(learner_actor, "LOOK_SECONDS", 0.1)
    monkeypatch.setattr(learner_actor, "SETTLE_SECONDS", 0.15)
    learner.flush_artifacts()
    assert len(tries) == 6
    tries.clear()
    learner._run_ends = True
    learner.flush_artifacts()
    assert len(tries) < 4


def test_a_last_checkpoint_that_is_damaged_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = LearnerActor.__new__(LearnerActor)
    learner._run_ends = learner._replaced = False
    monkeypatch.setattr(learner, "tend", raising(CheckpointError("does not match its manifest")))
    monkeypatch.setattr(learner_actor, "LOOK_SECONDS", 0.05)
    monkeypatch.setattr(learner_actor, "SETTLE_SECONDS", 0.15)
    began = time.monotonic()
    learner.flush_artifacts()
    assert time.monotonic() - began < 5.0
