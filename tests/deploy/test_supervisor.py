"""Which end of a role is one, and which is made good."""

import errno
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from rmc.common.env.process_state import ApartCall
from rmc.common.errors import RoleDied
from rmc.common.process.role import TERMINATED_STATUS
from rmc.common.process.watchdog import HUNG_STATUS
from rmc.deploy.local import role_process, supervisor
from rmc.deploy.local.fork_server import ForkServer
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.local.role_process import QuickDeaths, RoleProcess
from rmc.deploy.local.supervisor import Supervisor
from tests.waiting import wait_until


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A program in Python's place that ends at once, cleanly, as a role does after SIGTERM."""
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\nexit 0\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(role_process, "FIRST_BACKOFF", 0.01)
    return tmp_path


def tend_until(role: RoleProcess, seconds: float = 5.0) -> None:
    wait_until(lambda: role.tend() or role.finished, seconds, pause=0.01)


def variables_of_a_role(quick: Path, **variables: str) -> dict[str, str]:
    """What a role is started with, these among them."""
    Path(sys.executable).write_text(f"#!/bin/sh\nenv > {quick}/told\n")
    role = RoleProcess(RoleCommand("learner", ("learner",), ends=True), variables, quick)
    role.start()
    tend_until(role)
    return dict(row.split("=", 1) for row in (quick / "told").read_text().splitlines() if "=" in row)


def test_the_learner_may_end(quick: Path) -> None:
    role = RoleProcess(RoleCommand("learner", ("learner",), ends=True), {}, quick)
    role.start()
    tend_until(role)
    assert (role.finished, role.restarts) == (True, 0)


def test_what_was_exported_for_one_role_is_not_passed_on(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has its own Redis user, and its secret from a file; the shell that began a cluster may know others."""
    for name in ("RMC_SECRET", "RMC_REDIS_URL", "ANOTHER"):
        monkeypatch.setenv(name, "exported")
    variables = variables_of_a_role(quick, RMC_REDIS_URL="own")
    assert (variables.get("RMC_SECRET"), variables["RMC_REDIS_URL"], variables["ANOTHER"]) == (None, "own", "exported")


def test_what_an_environment_sets_for_itself_is_not_passed_on(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Roles that play import its module; a learner is to see its GPU."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setenv("NOT_FOR_IT", "ours")
    monkeypatch.setenv("ITS_OWN", "")
    monkeypatch.delenv("ITS_OWN")
    for gpu in ("1", ""):
        with ApartCall("Mine-v0", "make", 1.0):
            os.environ.update(CUDA_VISIBLE_DEVICES=gpu, ITS_OWN="theirs")
            os.environ.pop("NOT_FOR_IT", None)
    with ApartCall("Mine-v0", "reset", 1.0):
        assert (os.environ["CUDA_VISIBLE_DEVICES"], os.environ["ITS_OWN"]) == ("", "theirs")
    told = variables_of_a_role(quick)
    assert (told["CUDA_VISIBLE_DEVICES"], told["NOT_FOR_IT"], told.get("ITS_OWN")) == ("0", "ours", None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2")  # the caller's, since
    assert variables_of_a_role(quick)["CUDA_VISIBLE_DEVICES"] == "2"
    with ApartCall("Mine-v0", "make", 1.0):
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    assert variables_of_a_role(quick)["CUDA_VISIBLE_DEVICES"] == "2"


def test_a_role_starts_where_the_working_folder_is_gone(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one that is there: MKL, for one, is not loaded in one that is not."""
    Path(sys.executable).write_text(f"#!/bin/sh\npwd -P > {quick}/told\n")
    (gone := quick / "gone").mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    role = RoleProcess(RoleCommand("learner", ("learner",), ends=True), {}, quick)
    role.start()
    tend_until(role)
    assert (quick / "told").read_text() == "/\n"


def test_any_other_role_that_ends_unasked_is_started_again(quick: Path) -> None:
    role = RoleProcess(RoleCommand("actor-0", ("actor",)), {}, quick)
    role.start()
    with pytest.raises(RoleDied, match=r"3 times in a row soon after its start, exit status 0"):
        tend_until(role)
    assert role.restarts == 2


def test_one_that_hangs_soon_after_each_start_ends_the_run(tmp_path: Path) -> None:
    """However long it hung before it was ended for that."""
    deaths = RoleProcess(RoleCommand("actor-0", ("actor",), env_timeout=60.0), {}, tmp_path)._deaths
    deaths.note(HUNG_STATUS, 66.5, "")
    deaths.note(HUNG_STATUS, 66.5, "")
    with pytest.raises(RoleDied, match=rf"3 times in a row soon after its start, exit status {HUNG_STATUS}"):
        deaths.note(HUNG_STATUS, 66.5, "")


def test_one_that_hangs_in_c_soon_after_each_start_ends_the_run() -> None:
    """The interpreter ends it then, with a traceback and the status of any other error."""
    deaths, told = QuickDeaths("actor-0", 60.0), "Timeout (0:01:06)!\nThread 0x1 (most recent call first):"
    deaths.note(1, 66.5, told)
    deaths.note(1, 66.5, told)
    with pytest.raises(RoleDied, match="3 times in a row"):
        deaths.note(1, 66.5, told)
    deaths.note(1, 66.5, "Traceback (most recent call last)")  # that lived for long
    assert deaths.count == 0


def test_the_interpreters_words_of_a_hang_are_its_last(quick: Path) -> None:
    role = RoleProcess(RoleCommand("actor-0", ("actor",)), {}, quick)
    role.log.write_text("before\nTimeout (0:01:06)!\n" + "Thread\n" * 30)
    assert role.last_words().startswith("Timeout (0:01:06)!\nThread")


def test_an_earlier_starts_words_are_not_its_last(quick: Path) -> None:
    Path(sys.executable).write_text("#!/bin/sh\necho new\n")
    role = RoleProcess(RoleCommand("learner", ("learner",), ends=True), {}, quick)
    role.log.write_text("Traceback (most recent call last)\nold\n")
    role.start()
    tend_until(role)
    assert role.last_words() == "new"


def test_each_quick_death_doubles_the_wait(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not so one that others have ended."""
    monkeypatch.setattr(role_process, "FIRST_BACKOFF", 0.25)
    monkeypatch.setattr(role_process, "time", SimpleNamespace(monotonic=lambda: 100.0))
    role, waits = RoleProcess(RoleCommand("actor-0", ("actor",)), {}, quick), []
    role._started_at = 99.0
    for status in (1, 1, -9, 1):
        role._note_death(status)
        waits.append(role._start_at - 100.0)
    assert waits == [0.5, 1.0, 0.25, 0.5]


def test_what_a_role_has_started_goes_before_it_is_started_again(quick: Path) -> None:
    """Else two of its environments' simulators would have one port, or one display."""
    Path(sys.executable).write_text(f"#!/bin/sh\nsleep 60 &\necho $! >> {quick}/pids\nexit 0\n")
    role = RoleProcess(RoleCommand("learner", ("learner",), ends=True), {}, quick)
    role.start()
    tend_until(role)
    pid = int((quick / "pids").read_text())
    wait_until(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE, 5.0)


@pytest.mark.parametrize("end", ["kill -9 $$", "kill -15 $$", f"exit {TERMINATED_STATUS}"])
@pytest.mark.parametrize("ends", [False, True])
def test_a_role_that_others_kill_is_started_again_however_often(quick: Path, end: str, ends: bool) -> None:
    """The learner, too, whose end in order is that of the run."""
    Path(sys.executable).write_text(f"#!/bin/sh\n{end}\n")
    role = RoleProcess(RoleCommand("role", ("role",), ends=ends), {}, quick)
    role.start()
    wait_until(lambda: role.tend() or role.restarts >= 10, 20.0, pause=0.001)
    assert not role.finished
    role.signal(9)
    role.reap(5.0)


def test_a_role_that_crashes_ends_the_run(quick: Path) -> None:
    Path(sys.executable).write_text("#!/bin/sh\nkill -11 $$\n")
    role = RoleProcess(RoleCommand("actor-0", ("actor",)), {}, quick)
    role.start()
    with pytest.raises(RoleDied, match=r"3 times in a row soon after its start, killed by signal 11"):
        tend_until(role)


def test_a_learner_that_saves_for_long_is_not_killed_and_others_are(
    quick: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The replay server, which it may need, is told only then."""
    output = quick / "said"
    program = Path(sys.executable)
    program.write_text(ENDING.replace("SAID", str(output)))
    monkeypatch.setattr(supervisor, "STOP_SECONDS", 1.0)
    commands = [RoleCommand(name, (name,), forked=False) for name in ("replay", "actor", "learner")]
    keeper = Supervisor(commands, lambda _: {}, quick, lambda name: 6.0 if name == "learner" else 0.0)
    for role in keeper.roles.values():
        role.start()
    wait_until(lambda: output.exists() and len(output.read_text().split()) == 3)
    output.write_text("")
    keeper.stop()
    assert output.read_text().split() == ["learner", "replay"]
    assert [keeper.roles[name].status for name in ("learner", "replay", "actor")] == [0, 0, -9]


ENDING = """#!/bin/sh
case $4 in
    learner) trap 'sleep 2; echo learner >> SAID; exit 0' TERM ;;
    replay) trap 'echo replay >> SAID; exit 0' TERM ;;
    actor) trap '' TERM ;;
esac
echo ready >> SAID
while :; do sleep 0.05; done
"""


def test_where_no_process_can_be_started_now_it_is_tried_again(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(role_process, "LONGEST_BACKOFF", 0.01)
    role = RoleProcess(RoleCommand("learner", ("learner",), ends=True), {}, quick)
    begin, refusals = subprocess.Popen, iter([errno.EAGAIN, errno.ENOMEM])

    def scarce(*words: Any, **options: Any) -> Any:
        if number := next(refusals, None):
            raise OSError(number, os.strerror(number))
        return begin(*words, **options)

    monkeypatch.setattr(role_process.subprocess, "Popen", scarce)
    assert not role.start_or_wait()
    tend_until(role)
    assert (role.finished, role.restarts) == (True, 1)


@pytest.mark.skipif(sys.platform != "linux", reason="there is no fork server elsewhere")
def test_so_it_is_with_the_process_that_forks_roles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refusals = iter([errno.EAGAIN])
    start = ForkServer.start

    def scarce(self: ForkServer) -> None:
        if number := next(refusals, None):
            raise OSError(number, os.strerror(number))
        start(self)

    monkeypatch.setattr(role_process, "LONGEST_BACKOFF", 0.01)
    monkeypatch.setattr(ForkServer, "start", scarce)
    waits = {"RMC_REDIS_URL": "unix:///nowhere", "RMC_PATIENCE": "99"}
    command = RoleCommand("actor-0", ("role", "actor", "--run", "x", "--index", "0"))
    roles = Supervisor([command], lambda _: waits, tmp_path, lambda _: 0.0)
    try:
        roles.start()
        assert not roles.roles["actor-0"].running
        wait_until(lambda: roles.tend() or roles.roles["actor-0"].running, 60.0)
    finally:
        roles.stop()


def test_another_fault_of_a_start_is_told(quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    role = RoleProcess(RoleCommand("learner", ("learner",)), {}, quick)
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with pytest.raises(FileNotFoundError):
        role.tend()
