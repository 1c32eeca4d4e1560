"""Faults within running roles: Python reads this file first of all where it stands on PYTHONPATH.

A file in the folder RMC_FAULTS arms the fault of its name, which takes the file away and happens once, in whichever
role comes to that point next.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

FOLDER = Path(os.environ.get("RMC_FAULTS", "/nonexistent"))


def strikes(fault: str) -> bool:
    """Whether it was armed."""
    try:
        (FOLDER / fault).unlink()
    except FileNotFoundError:
        return False
    return True


def say(name: str, **facts: object) -> None:
    """A line for the script that watches."""
    with (FOLDER / f"said-{name}").open("a") as file:
        file.write(json.dumps(facts) + "\n")


def times_slower() -> float:
    """How many times as long an update of the learner takes: what a file says that stays."""
    path = FOLDER / "slower"
    return float(path.read_text()) if path.exists() else 1.0


def die() -> None:
    """At once, as by kill -9."""
    say("died", at=time.time())
    os.kill(os.getpid(), signal.SIGKILL)


def after(owner: Any, method: str, fault: str) -> None:
    """Die when the method has done its work."""
    original = getattr(owner, method)

    def done(*args: Any, **words: Any) -> Any:
        result = original(*args, **words)
        if strikes(fault):
            die()
        return result

    setattr(owner, method, done)


def replay_server() -> None:
    """Every point between a read and its ack."""
    from rmc.common.bus.redis_bus import RedisBus
    from rmc.replay_server.commit_record import _HEADER, RecordPair
    from rmc.replay_server.recovery import ReplayStore, valid_leaves
    from rmc.replay_server.ring import Ring
    from rmc.replay_server.server import ReplayServer
    from rmc.replay_server.stream_reader import StreamReader
    from rmc.replay_server.sum_tree import SumTree

    write, commit, record = Ring.write, Ring.commit, RecordPair.write
    step, read = ReplayServer.step, StreamReader.read
    taking_in = [""]  # ``written`` amid an append's step (a), ``committed`` amid its step (c): draws commit, too

    def half_the_rows(self: Any, rows: Any) -> Any:
        taking_in[0] = "written"
        serials = range(self.progress.next_serial, self.progress.next_serial + len(rows))
        kept = [serial % self.capacity for serial in serials][-self.capacity :][len(rows) // 2 :]
        before = self._blocks[kept].copy()
        slots = write(self, rows)
        taking_in[0] = ""
        if len(rows) > 1 and strikes("half-the-rows"):
            self._blocks[kept] = before
            die()
        return slots

    def committed(self: Any, rows: int = 0) -> None:
        taking_in[0] = "committed" if rows else ""
        commit(self, rows)
        if taking_in[0] and strikes("committed"):
            die()
        taking_in[0] = ""

    def half_a_record(self: Any, progress: Any) -> None:
        copy = self._copies[(self._sequence + 1) % 2]
        before = bytes(copy)
        record(self, progress)
        if taking_in[0] == "written" and strikes("record"):
            die()
        if taking_in[0] == "committed" and strikes("half-a-record"):
            half = (_HEADER.size + len(progress.encode())) // 2
            copy[half:] = before[half:]
            die()

    def all_there(self: Any, positions: Any) -> Any:
        batch = read(self, positions)
        if self.gaps:
            say("gap", gaps=self.gaps)
        return batch

    def compared(self: Any) -> bool:
        if strikes("compare-tree"):
            rebuilt = SumTree(self._store.ring.capacity)
            rebuilt.rebuild(valid_leaves(self._store))
            say("tree", same=bool((rebuilt._nodes == self._store.tree._nodes).all()))
        return bool(step(self))

    Ring.write, Ring.commit, RecordPair.write = half_the_rows, committed, half_a_record  # type: ignore[method-assign]
    ReplayServer.step, StreamReader.read = compared, all_there  # type: ignore[method-assign]
    after(StreamReader, "read", "read")
    after(Ring, "write", "rows")
    after(ReplayStore, "set_priorities", "priorities")
    after(RedisBus, "commit", "acknowledged")
    after(ReplayServer, "sample", "drawn")


def learner() -> None:
    """Amid saving; what it resumes from; a loss that is no number; slow updates; no memory to share."""
    if (FOLDER / "no-shared-memory").exists():
        del os.memfd_create
    import torch

    from rmc.common import checkpoint
    from rmc.common.checkpoint import STATE
    from rmc.learner.device_update import DeviceUpdate
    from rmc.learner.learner import Learner

    write, resume, update = checkpoint.write_synced, Learner._resume, DeviceUpdate.__call__

    def half_a_file(path: Path, content: bytes) -> None:
        if path.name == STATE and strikes("half-a-checkpoint"):
            path.write_bytes(content[: len(content) // 2])
            die()
        write(path, content)

    def compared(self: Any) -> int:
        epoch = resume(self)
        checkpoint = self.checkpoints.latest()
        if checkpoint is not None:
            state = torch.load(self.checkpoints.path(checkpoint[0]) / STATE, weights_only=True)
            newest = checkpoint[0] == max(self.checkpoints.numbers())  # which no kill has cut short
            say("resumed", number=checkpoint[0], same=newest and _same(state, self.update.state_dict()))
        return epoch

    def slower(self: Any, raw: Any, importance: Any, beta: float, number: int) -> Any:
        began = time.monotonic()
        if strikes("nan"):
            importance = importance * float("nan")  # with which the loss is a mean
            say("nan")
        result = update(self, raw, importance, beta, number)
        time.sleep((times_slower() - 1) * (time.monotonic() - began))
        return result

    checkpoint.write_synced, Learner._resume = half_a_file, compared  # type: ignore[method-assign]
    DeviceUpdate.__call__ = slower  # type: ignore[method-assign]
    after(checkpoint, "_sync_folder", "synchronised")
    after(checkpoint.CheckpointFolder, "save", "saved")


def _same(one: Any, other: Any) -> bool:
    """To the last bit."""
    import torch

    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, torch.Tensor):
        return one.dtype == other.dtype and one.cpu().numpy().tobytes() == other.cpu().numpy().tobytes()
    return bool(one == other)


if "replay" in sys.orig_argv:
    replay_server()
elif "learner" in sys.orig_argv:
    learner()
