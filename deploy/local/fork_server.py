"""The supervisor's end of the fork server; the program itself is ``rmc/cli/fork_server.py``."""

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import msgpack

from rmc.common.errors import RoleDied
from rmc.deploy.local.role_environment import SINGLE_THREAD, start_process

POLL_SECONDS = 0.01
LOOK_SECONDS = 0.2  # between looks at whether to stop
END_SECONDS = 2.0
IMPORT_SECONDS, REPLY_SECONDS = 120.0, 10.0  # until one that does not answer counts as gone
LARGEST = 65_536  # bytes of a request


def open_log(path: Path) -> BinaryIO:
    """A log to append to; where its folder is gone or read-only, which the launcher says, one that keeps nothing."""
    try:
        return path.open("ab")
    except OSError:
        return open(os.devnull, "ab")


class ForkedProcess:
    """A process that a fork server forked; what it has of ``subprocess.Popen`` does the same."""

    def __init__(self, fork_server: "ForkServer", generation: int, pid: int) -> None:
        self._fork_server, self._generation, self.pid = fork_server, generation, pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Its exit status, negative for a signal; None while it runs."""
        if self.returncode is None:
            self.returncode = self._fork_server.status_of(self.pid, self._generation)
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit status, once it has one. Raises subprocess.TimeoutExpired."""
        deadline = time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() >= deadline:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(POLL_SECONDS)
        return status


class ForkServer:
    """Started with the first role, and again if it is killed: with it go those it forked."""

    def __init__(self, log: Path, stopped: Callable[[], bool] = lambda: False) -> None:
        """``stopped`` says whether it is no longer needed: nobody waits then for what it imports."""
        self._log, self._stopped = log, stopped
        self._program: subprocess.Popen[bytes] | None = None
        self._generation = 0  # of the program
        self._status: int | None = None  # with which the last one ended; None where it hung
        self._ours: socket.socket | None = None
        self._is_importing, self._hung = False, False

    def fork(self, words: tuple[str, ...], environment: dict[str, str], log: int) -> ForkedProcess:
        """A process of ``rmc`` and these words, its output to ``log``.

        Raises RoleDied where no fork server comes up; OSError where the system has no room for a process, or somebody
        killed that server as it came up; KeyboardInterrupt where ``stopped`` says so while it imports.
        """
        request = {"words": words, "environment": environment}
        for _ in range(2):  # one that was killed since is found out by asking it
            self.start()
            pid = self._ask(request, log)
            if pid == 0:
                raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            if pid is not None:
                return ForkedProcess(self, self._generation, pid)
        if self._status in (-signal.SIGKILL, -signal.SIGTERM):
            raise OSError(errno.EAGAIN, "the fork server of roles was killed")
        if self._hung:
            fix = "is the disk with Python's packages slow, or are the CPUs taken?"
            raise RoleDied(f"the fork server of roles has not begun within {IMPORT_SECONDS:.0f} s, twice; {fix}")
        raise RoleDied(f"the fork server of roles does not start; its log is {self._log}")

    def status_of(self, pid: int, generation: int) -> int | None:
        """The exit status of one that it forked; those of a fork server that is gone were killed with it."""
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
        words = [sys.executable, "-P", "-m", "rmc.cli.fork_server", str(theirs.fileno())]
        with theirs, open_log(self._log) as log:
            self._program = start_process(words, log, SINGLE_THREAD, (theirs.fileno(),))
        self._generation += 1
        self._ours.settimeout(LOOK_SECONDS)
        self._is_importing = True

    def _ask(self, request: Any, descriptor: int | None = None) -> Any:
        """Its reply, or None where it is gone."""
        assert self._ours is not None
        try:
            socket.send_fds(self._ours, [msgpack.packb(request)], [] if descriptor is None else [descriptor])
            reply = self._reply(self._ours)
        except OSError as error:
            reply, self._hung = b"", isinstance(error, TimeoutError)
        if not reply:
            self.close()
            return None
        return msgpack.unpackb(reply)

    def _reply(self, ours: socket.socket) -> bytes:
        """Empty where it has ended. Raises TimeoutError where it hangs; KeyboardInterrupt as ``fork`` does."""
        deadline = time.monotonic() + (IMPORT_SECONDS if self._is_importing else REPLY_SECONDS)
        while True:
            try:
                reply = ours.recv(LARGEST)
            except TimeoutError:
                if self._is_importing and self._stopped():
                    raise KeyboardInterrupt from None
                if time.monotonic() >= deadline:
                    raise
            else:
                self._is_importing = False
                return reply

    def close(self) -> None:
        """End it, and with it those that it forked."""
        if self._ours is not None:
            self._ours.close()
            self._ours = None
        if self._program is not None:
            self._status = None
            try:
                self._status = self._program.wait(END_SECONDS)
            except subprocess.TimeoutExpired:
                self._program.kill()
                self._program.wait()
            self._program = None
