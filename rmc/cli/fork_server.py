"""Where roles that need one thread are forked from: what they import is in memory there, which saves each seconds.

``deploy/local/fork_server.py`` is the supervisor's end; this is the program:
``python -P -m rmc.cli.fork_server DESCRIPTOR``.
One request and its reply at a time, msgpack, over a pair of sockets: ``{words, environment}`` with the descriptor of a
log gives the process number of a new role, a process number gives its exit status, once it has one.
"""

import gc
import importlib
import os
import signal
import socket
import sys
import traceback
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
import setproctitle
import torch

from rmc.common.process import descendants, parent_death
from rmc.deploy.local.fork_server import LARGEST
from rmc.deploy.local.role_environment import command_line


def serve(requests: socket.socket) -> None:
    """Fork what is asked for, until the other end is closed."""
    _import_all()
    descendants.adopt_orphans()
    parent_death.outlive_parent()
    roles: set[int] = set()
    while True:
        raw, descriptors, _, _ = socket.recv_fds(requests, LARGEST, 1)
        if not raw:
            return
        request = msgpack.unpackb(raw)
        if isinstance(request, int):
            requests.send(msgpack.packb(_status(request, roles)))
            continue
        for log in descriptors:
            roles.add(pid := _forked(requests, request, log))
            requests.send(msgpack.packb(pid))
            os.close(log)


def _forked(requests: socket.socket, request: dict[str, Any], log: int) -> int:
    """The process number of a new role; 0 where there is no room for one."""
    fork_server = os.getpid()
    try:
        pid = os.fork()
    except OSError:
        return 0
    if pid == 0:
        requests.close()
        _be(request["words"], {**request["environment"], parent_death.PARENT_VARIABLE: str(fork_server)}, log)
    os.setpgid(pid, 0)  # said here, too: who hears of it may signal its group at once
    return pid


def _import_all() -> None:
    """What the roles import, and what gymnasium imports when it makes one of MuJoCo's environments."""
    with suppress(Exception):  # MUJOCO_GL may be wrong: an environment that needs MuJoCo says so
        importlib.import_module("gymnasium.envs.mujoco.mujoco_env")
    for module in ("rmc.cli.role_commands", "rmc.deploy.local.actor_process"):
        importlib.import_module(module)
    gc.collect()
    gc.freeze()  # the collector does not write to these pages, so that they stay shared


def _status(pid: int, roles: set[int]) -> int | str:
    """Of a role; with one that has ended goes what its environments started, which has come to us."""
    ended, status = os.waitpid(pid, os.WNOHANG)
    if not ended:
        return "running"
    roles.discard(pid)
    descendants.end_children(roles)
    return os.waitstatus_to_exitcode(status)


def _be(words: list[str], environment: dict[str, str], log: int) -> None:
    """In the new process: become the role; never returns."""
    try:
        os.setpgid(0, 0)
        for stream in (1, 2):
            os.dup2(log, stream)
        os.close(log)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        np.random.seed()  # noqa: NPY002 - an environment may draw from these, and forks would all draw the same
        torch.seed()
        os.environ.update(environment)
        sys.argv = ["rmc", *words]
        setproctitle.setproctitle(" ".join(command_line(words)))
        from rmc.cli import main

        main.main()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(1)


if __name__ == "__main__":
    parent_death.exit_with_parent(int(os.environ.pop(parent_death.PARENT_VARIABLE)))
    for number in (signal.SIGINT, signal.SIGTERM):  # roles end cleanly first
        signal.signal(number, signal.SIG_IGN)
    try:
        serve(socket.socket(fileno=int(sys.argv[1])))
    except BaseException:
        traceback.print_exc()
    finally:
        descendants.end_children()
        os._exit(0)  # at once: Python's own clearing up takes seconds here
