"""Where roles that need one thread are forked from: what they import is in memory there, which saves each seconds.

``Nursery`` is the supervisor's end; the other is this file as a program, ``python -P -m deploy.nursery DESCRIPTOR``.
One request and its reply at a time, msgpack, over a pair of sockets: ``{words, environment}`` with the descriptor of a
log gives the process number of a new role, a process number gives its exit status, once it has one.
"""

import gc
import os
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import setproctitle

from common.errors import RoleDied
from deploy import lifeline

SINGLE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
SECRET_VARIABLE, URL_VARIABLE = "RMC_SECRET", "RMC_REDIS_URL"  # each for one role: what it starts does not inherit it
LARGEST = 65_536  # bytes of a request
POLL_SECONDS = 0.01
END_SECONDS = 2.0
IMPORT_SECONDS, REPLY_SECONDS = 120.0, 10.0  # until one that does not answer counts as gone
FAILED_STATUS = 1


def command_line(words: Sequence[str]) -> list[str]:
    """A role's, in a process of its own; one that is forked bears it as its title."""
    return [sys.executable, "-P", "-m", "deploy.cli", *words]


def inherited() -> dict[str, str]:
    """What a role's process has of this one's environment: no secret, whoever set it here."""
    return {name: value for name, value in os.environ.items() if name not in (SECRET_VARIABLE, URL_VARIABLE)}


class Forked:
    """A process that a nursery forked; what it has of ``subprocess.Popen`` does the same."""

    def __init__(self, nursery: "Nursery", generation: int, pid: int, returncode: int | None = None) -> None:
        self._nursery, self._generation, self.pid = nursery, generation, pid
        self.returncode = returncode

    def poll(self) -> int | None:
        """Its exit status, negative for a signal; None while it runs."""
        if self.returncode is None:
            self.returncode = self._nursery.status_of(self.pid, self._generation)
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit status, once it has one. Raises subprocess.TimeoutExpired."""
        deadline = time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() >= deadline:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(POLL_SECONDS)
        return status


class Nursery:
    """Started with the first role, and again if it is killed: with it go those it forked."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._program: subprocess.Popen[bytes] | None = None
        self._generation = 0  # of the program
        self._ours: socket.socket | None = None

    def fork(self, words: tuple[str, ...], environment: dict[str, str], log: int) -> Forked:
        """A process of ``rmc`` and these words, its output to ``log``. Raises RoleDied where no nursery comes up.

        Where the system has no room for a process, its log says so and it has ended already.
        """
        request = {"words": words, "environment": environment}
        for _ in range(2):  # one that was killed since is found out by asking it
            self.start()
            pid = self._ask(request, log)
            if pid is not None:
                return Forked(self, self._generation, pid, None if pid else FAILED_STATUS)
        raise RoleDied(f"the nursery of roles does not start; its log is {self._log}")

    def status_of(self, pid: int, generation: int) -> int | None:
        """The exit status of one that it forked; those of a nursery that is gone were killed with it."""
        if generation != self._generation or self._program is None or self._program.poll() is not None:
            return -signal.SIGKILL
        reply = self._ask(pid)
        if reply is None:
            return -signal.SIGKILL
        return None if reply == "running" else int(reply)

    def start(self) -> None:
        """Unless it is there."""
        if self._program is not None and self._program.poll() is None:
            return
        self.close()
        self._ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        environment = {**inherited(), **SINGLE_THREAD, lifeline.PARENT_VARIABLE: str(os.getpid())}
        words = [sys.executable, "-P", "-m", "deploy.nursery", str(theirs.fileno())]
        with theirs, self._log.open("ab") as log:
            self._program = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, process_group=0,
                pass_fds=(theirs.fileno(),),
            )  # fmt: skip
        self._generation += 1
        self._ours.settimeout(IMPORT_SECONDS)

    def _ask(self, request: Any, descriptor: int | None = None) -> Any:
        """Its reply, or None where it is gone."""
        assert self._ours is not None
        try:
            socket.send_fds(self._ours, [msgpack.packb(request)], [] if descriptor is None else [descriptor])
            reply = self._ours.recv(LARGEST)
            self._ours.settimeout(REPLY_SECONDS)
        except OSError:  # or it hangs
            reply = b""
        if not reply:
            self.close()
            return None
        return msgpack.unpackb(reply)

    def close(self) -> None:
        """End it, and with it those that it forked."""
        if self._ours is not None:
            self._ours.close()
            self._ours = None
        if self._program is not None:
            try:
                self._program.wait(END_SECONDS)
            except subprocess.TimeoutExpired:
                self._program.kill()
                self._program.wait()
            self._program = None


def serve(requests: socket.socket) -> None:
    """Fork what is asked for, until the other end is closed."""
    _import_all()
    while True:
        raw, descriptors, _, _ = socket.recv_fds(requests, LARGEST, 1)
        if not raw:
            return
        request = msgpack.unpackb(raw)
        if isinstance(request, int):
            requests.send(msgpack.packb(_status(request)))
            continue
        for log in descriptors:
            requests.send(msgpack.packb(_forked(requests, request, log)))
            os.close(log)


def _forked(requests: socket.socket, request: dict[str, Any], log: int) -> int:
    """The process number of a new role; 0 where there is no room for one."""
    nursery = os.getpid()
    try:
        pid = os.fork()
    except OSError as error:
        os.write(log, f"no process can be forked: {error.strerror}\n".encode())
        return 0
    if pid == 0:
        requests.close()
        _be(request["words"], {**request["environment"], lifeline.PARENT_VARIABLE: str(nursery)}, log)
    _lead_group(pid)  # here, too: who hears of it may signal its group at once
    return pid


def _import_all() -> None:
    """What the roles import, and what gymnasium imports when it makes one of MuJoCo's environments."""
    import gymnasium.envs.mujoco.mujoco_env

    import deploy.commands

    assert deploy.commands, gymnasium.envs.mujoco.mujoco_env
    gc.collect()
    gc.freeze()  # the collector does not write to these pages, so that they stay shared


def _status(pid: int) -> int | str:
    found, status = os.waitpid(pid, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else "running"


def _be(words: list[str], environment: dict[str, str], log: int) -> None:
    """In the new process: become the role; never returns."""
    try:
        _lead_group(0)
        for stream in (1, 2):
            os.dup2(log, stream)
        os.close(log)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        np.random.seed()  # noqa: NPY002 - an environment may draw from it, and forks would all draw the same
        os.environ.update(environment)
        sys.argv = ["rmc", *words]
        setproctitle.setproctitle(" ".join(command_line(words)))
        from deploy import cli

        cli.main()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(1)


def _lead_group(pid: int) -> None:
    os.setpgid(pid, 0)


if __name__ == "__main__":
    lifeline.die_with(int(os.environ.pop(lifeline.PARENT_VARIABLE)))
    for number in (signal.SIGINT, signal.SIGTERM):  # roles end in order first
        signal.signal(number, signal.SIG_IGN)
    try:
        serve(socket.socket(fileno=int(sys.argv[1])))
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(0)  # at once: Python's own clearing up takes seconds here
