"""Roles forked from a fork server: as their own processes would be, and gone with it."""

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from rmc.cli import fork_server
from rmc.common.errors import RoleDied
from rmc.common.process.role import TERMINATED_STATUS
from rmc.deploy.local.fork_server import IMPORT_SECONDS, ForkedProcess, ForkServer
from tests.raising import raising
from tests.waiting import wait_until

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="nothing is forked elsewhere")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ForkServer]:
    one = ForkServer(tmp_path_factory.mktemp("fork_server") / "fork_server.log")
    one.start()
    yield one
    one.close()


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> None:
    """Not after each of these tests, which share a fork server."""


def fork(shared: ForkServer, log: Path, *words: str, **environment: str) -> ForkedProcess:
    with log.open("ab") as file:
        return shared.fork(words, environment, file.fileno())


def fork_actor(shared: ForkServer, log: Path, index: str, **environment: str) -> ForkedProcess:
    return fork(shared, log, "role", "actor", "--run", "x", "--index", index, **environment)


def test_it_is_rmc_with_its_words(shared: ForkServer, tmp_path: Path) -> None:
    role = fork_actor(shared, tmp_path / "log", "0", RMC_REDIS_URL="unix:///nowhere", RMC_PATIENCE="0")
    assert role.wait(20) == 2
    assert "--redis-url='unix:///nowhere'" in (tmp_path / "log").read_text()
    assert role.poll() == 2  # it is still known


def test_it_leads_a_group_has_its_title_and_dies_of_a_signal(shared: ForkServer, tmp_path: Path) -> None:
    role = fork_actor(shared, tmp_path / "log", "7", RMC_REDIS_URL="unix:///a", RMC_PATIENCE="99")
    assert os.getpgid(role.pid) == role.pid
    assert role.poll() is None
    with pytest.raises(subprocess.TimeoutExpired):
        role.wait(0.2)
    words = "-P -m rmc.cli.main role actor --run x --index 7"
    wait_until(lambda: " ".join(psutil.Process(role.pid).cmdline()).endswith(words))
    os.killpg(role.pid, signal.SIGKILL)
    assert role.wait(5) == -signal.SIGKILL


def test_one_that_is_ended_while_it_waits_for_redis_says_so(shared: ForkServer, tmp_path: Path) -> None:
    role = fork_actor(shared, tmp_path / "log", "0", RMC_REDIS_URL="unix:///a", RMC_PATIENCE="99")
    wait_until(lambda: "waiting up to" in (tmp_path / "log").read_text(), 20)
    os.kill(role.pid, signal.SIGTERM)
    assert role.wait(20) == TERMINATED_STATUS


def test_with_the_fork_server_go_those_it_forked_and_another_begins(shared: ForkServer, tmp_path: Path) -> None:
    words = ("role", "actor", "--run", "x", "--index", "0")
    role = fork(shared, tmp_path / "log", *words, RMC_REDIS_URL="unix:///a", RMC_PATIENCE="99")
    process = psutil.Process(role.pid)
    assert shared._program is not None
    shared._program.kill()
    assert role.wait(5) == -signal.SIGKILL
    process.wait(5)
    after = fork(shared, tmp_path / "log", *words, RMC_REDIS_URL="unix:///a", RMC_PATIENCE="1")
    assert after.poll() is None
    assert role.poll() == -signal.SIGKILL
    after.wait(20)


def test_one_that_does_not_start_says_where_to_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\necho no torch here\nexit 1\n")
    broken.chmod(0o700)
    monkeypatch.setattr(fork_server.sys, "executable", str(broken))
    one = ForkServer(tmp_path / "fork_server.log")
    with pytest.raises(RoleDied, match=r"does not start; its log is .*fork_server\.log"):
        fork(one, tmp_path / "log", "actor")
    one.close()
    assert (tmp_path / "fork_server.log").read_text() == "no torch here\n" * 2


def test_one_that_does_not_begin_in_time_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slow = tmp_path / "python"
    slow.write_text("#!/bin/sh\nexec sleep 60\n")
    slow.chmod(0o700)
    monkeypatch.setattr(fork_server.sys, "executable", str(slow))
    monkeypatch.setattr("rmc.deploy.local.fork_server.IMPORT_SECONDS", 0.2)
    monkeypatch.setattr("rmc.deploy.local.fork_server.END_SECONDS", 0.2)
    with pytest.raises(RoleDied, match=r"has not begun within 0 s, twice; is the disk .* slow, or are the CPUs taken"):
        fork(ForkServer(tmp_path / "fork_server.log"), tmp_path / "log", "actor")


def test_one_that_is_killed_as_it_starts_is_tried_again_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a machine short of memory does it; a role that cannot be started now is started later."""
    killed = tmp_path / "python"
    killed.write_text("#!/bin/sh\nkill -KILL $$\n")
    killed.chmod(0o700)
    monkeypatch.setattr(fork_server.sys, "executable", str(killed))
    one = ForkServer(tmp_path / "fork_server.log")
    with pytest.raises(BlockingIOError, match="the fork server of roles was killed"):
        fork(one, tmp_path / "log", "actor")
    one.close()


def test_nobody_who_stops_waits_for_what_it_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the first seconds of a run, which are many on a busy machine or a slow disk."""
    slow = tmp_path / "python"
    slow.write_text("#!/bin/sh\nexec sleep 100\n")
    slow.chmod(0o700)
    monkeypatch.setattr(fork_server.sys, "executable", str(slow))
    began = time.monotonic()
    one = ForkServer(tmp_path / "fork_server.log", lambda: time.monotonic() - began > 1)
    with pytest.raises(KeyboardInterrupt):
        fork(one, tmp_path / "log", "actor")
    one.close()
    assert time.monotonic() - began < IMPORT_SECONDS / 4


def test_one_that_hangs_is_given_up_for_another(
    shared: ForkServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmc.deploy.local.fork_server.REPLY_SECONDS", 0.3)
    words = ("role", "actor", "--run", "x", "--index", "0")
    role = fork(shared, tmp_path / "log", *words, RMC_REDIS_URL="unix:///a", RMC_PATIENCE="99")
    process, hung = psutil.Process(role.pid), shared._program
    assert hung is not None
    hung.send_signal(signal.SIGSTOP)
    began = time.monotonic()
    assert role.wait(5) == -signal.SIGKILL  # it cannot be asked
    assert time.monotonic() - began < IMPORT_SECONDS / 2  # which it may take at its start alone
    process.wait(5)
    assert hung.returncode == -signal.SIGKILL
    monkeypatch.undo()
    assert fork(shared, tmp_path / "log", *words, RMC_REDIS_URL="unix:///a", RMC_PATIENCE="0").wait(20) == 2


def test_a_system_without_room_for_a_process_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fork_server.os, "fork", raising(OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))))
    ours, theirs = socket.socketpair()
    with ours, theirs, open("/dev/full", "ab") as log:
        assert fork_server._forked(theirs, {"words": [], "environment": {}}, log.fileno()) == 0
    refusing = ForkServer(tmp_path / "fork_server.log")
    monkeypatch.setattr(refusing, "start", lambda: None)
    monkeypatch.setattr(refusing, "_ask", lambda *_: 0)
    with pytest.raises(BlockingIOError, match="temporarily unavailable"):  # as of any other process
        fork(refusing, tmp_path / "log")


FORKS_THAT_DRAW = """
import os, socket, sys, types
import numpy as np
import torch
from rmc import cli
from rmc.cli import fork_server

np.random.seed(0)
cli.main = sys.modules["rmc.cli.main"] = types.ModuleType("rmc.cli.main")
cli.main.main = lambda: print(np.random.random(), torch.rand(()).item(), flush=True)
for _ in range(2):
    pid = fork_server._forked(socket.socket(), {"words": [], "environment": {}}, os.dup(1))
    os.waitpid(pid, 0)
"""


def test_forks_do_not_draw_the_same_numbers() -> None:
    output = subprocess.run([sys.executable, "-c", FORKS_THAT_DRAW], capture_output=True, text=True, check=True).stdout
    assert len(set(output.split())) == 4


def test_what_its_roles_import_is_there_before_it_forks_also_with_a_wrong_mujoco_gl() -> None:
    """Else each role has a copy of its own: some 100 MB, and seconds at every start."""
    ask = "import sys; from rmc.cli import fork_server as one; one._import_all(); print(*sys.modules)"
    wrong = {**os.environ, "MUJOCO_GL": "nonsense"}
    output = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True, env=wrong).stdout
    assert "rmc.actors.actor" in output.split()
