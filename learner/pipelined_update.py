"""An update's two halves on two cores: memory and world model in a process of their own, some batches ahead.

With scheme 3 no loss of memory and world model reads critics, policy or temperature. So nothing flows back, and all
numbers are those of the halves one after the other. Weights and moments of both lie in memory that both processes see;
whoever reads them calls ``drain`` first. Shapes: B batch.
"""

import math
import mmap
import os
import signal
import socket
import struct
import sys
import traceback
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NoReturn

import setproctitle
import torch
from torch import Tensor

from rmc.common.errors import RmcError
from rmc.common.process.parent_death import exit_with_parent
from rmc.common.window import WindowSpec
from rmc.learner.batch import Batch, Plan, view_batch
from rmc.learner.config import MODEL_PROCESS
from rmc.learner.optimizers import begin_moments
from rmc.learner.update import ACTOR_CRITIC_PARTS, MODEL_PARTS, JointUpdate, ModelPass, UpdateResult

AHEAD = 2  # batches that the model's half may be ahead
REQUEST = struct.Struct("qqq???")  # an update's number, the threads that it takes, its plan
ALIGNMENT = 64  # bytes, a cache line


@dataclass(frozen=True)
class Slot:
    """A batch and what the model's half makes of it, in shared memory."""

    raw: Tensor  # (B, row bytes) uint8
    importance: Tensor  # (B,); this and beta are not shared, as the model's half reads neither
    beta: Tensor
    model: ModelPass
    norm: Tensor  # of the model's gradient

    def model_of(self, batch: Batch) -> ModelPass:
        """Where the model's half of that batch lies: the beginning of each place, where the batch is cut."""
        whole = self.model
        z, next_z, curiosity, hidden = (
            _cut(place, batch.cut) for place in (whole.z, whole.next_z, whole.curiosity, whole.hidden)
        )
        untrained = set() if batch.plan.trains_imputer else {"fill_loss"}  # whose place has an earlier batch's
        metrics = {name: value for name, value in whole.metrics.items() if name not in untrained}
        return whole._replace(z=z, next_z=next_z, curiosity=curiosity, hidden=hidden, metrics=metrics)

    def write(self, batch: Batch, model: ModelPass, norm: Tensor) -> None:
        """Put the model's half of that batch in."""
        for place, tensor in zip(self.model_of(batch)[:-1], model[:-1], strict=True):
            place.copy_(tensor.detach())
        for name, value in model.metrics.items():
            self.model.metrics[name].copy_(value)
        self.norm.copy_(norm)


class PipelinedUpdate:
    """An update of batches of one size. A checkpoint must be taken up before the first call, not after."""

    in_flight = 0

    def __init__(self, update: JointUpdate, spec: WindowSpec, batch_size: int) -> None:
        self._update, self._spec, self._batch_size = update, spec, batch_size
        self._threads = 1  # of each half
        self._pending: deque[tuple[Slot, int, Plan]] = deque()
        self._slots: list[Slot] = []
        self._child = 0
        self._exit_code: int | None = None  # its, once it has ended
        self._pipe: socket.socket | None = None

    def __call__(self, raw: Tensor, importance: Tensor, beta: float, number: int) -> list[UpdateResult]:
        """(B, row bytes) uint8, whose padding is zero, (B,) float32, and the update's number, one more than that of the
        call before; results, the oldest first.

        What it returns is overwritten by a later call. Raises RmcError where the other process has ended.
        """
        if not self._slots:
            self._start()
        slot = self._slots[number % len(self._slots)]
        slot.raw.copy_(raw)
        slot.importance.copy_(importance)
        slot.beta.fill_(beta)
        plan = self._update.plan(raw, self._spec, number)
        self._send(number, plan)
        self._pending.append((slot, number, plan))
        return [self._finish()] if len(self._pending) > AHEAD else []

    def use_threads(self, number: int) -> None:
        """So many for each half, from the next call on."""
        self._threads = number
        if self._slots:  # nothing may run on several before the other process is there
            torch.set_num_threads(number)

    def drain(self) -> list[UpdateResult]:
        """The results of all that is pending; then no other process writes weights."""
        return [self._finish() for _ in range(len(self._pending))]

    def close(self) -> None:
        """End the other process."""
        if self._pipe is not None:
            self._pipe.close()
            self._reap()
            self._pipe = None

    def _reap(self) -> int:
        """Exit code of the other process, once it has ended; below 0 a signal's."""
        if self._exit_code is None:
            self._exit_code = os.waitstatus_to_exitcode(os.waitpid(self._child, 0)[1])
        return self._exit_code

    def _fail(self) -> NoReturn:
        """Raises RmcError with how the other process has ended."""
        code = self._reap()
        how = f"was killed by signal {-code}" if code < 0 else "has ended; the lines above say why"
        hint = "; is memory short?" if code == -signal.SIGKILL else ""
        raise RmcError(f"the process of memory and world model {how}{hint}") from None

    def _send(self, number: int, plan: Plan) -> None:
        assert self._pipe is not None
        try:
            self._pipe.sendall(REQUEST.pack(number, self._threads, *plan))
        except OSError:
            self._fail()

    def _await_answer(self) -> None:
        assert self._pipe is not None
        try:
            answered = self._pipe.recv(1)
        except OSError:
            answered = b""
        if not answered:
            self._fail()

    def _finish(self) -> UpdateResult:
        self._await_answer()
        (slot, number, plan), update = self._pending.popleft(), self._update
        batch = view_batch(slot.raw, slot.importance, self._spec, plan)
        model = slot.model_of(batch)
        actor_critic, norm = update.train_actor_critic(batch, model, slot.beta)
        update.average.update(number, ACTOR_CRITIC_PARTS)
        return update.result(batch, model, actor_critic, torch.hypot(norm, slot.norm))

    def _start(self) -> None:
        """Share what both halves touch, and fork; before it, nothing may have run on several threads."""
        update = self._update
        optimizer = update.optimizers[0]
        begin_moments(optimizer, (value for group in optimizer.param_groups for value in group["params"]))
        moments = [value for state in optimizer.state.values() for value in state.values()]
        own = [value for name, value in update.agent.named_parameters() if name.startswith(MODEL_PARTS)]
        _share(
            [
                *own,
                *moments,
                *update.average.tensors(MODEL_PARTS),
                *update.agent.normalizer.buffers(),
                update.curiosity_variance,
            ]
        )
        self._slots = [self._make_slot() for _ in range(AHEAD + 1)]
        ours, theirs = socket.socketpair()
        parent = os.getpid()
        try:
            child = os.fork()
        except OSError:
            ours.close()
            theirs.close()
            raise
        if child == 0:
            self._run_child(parent, theirs)
        theirs.close()
        self._child, self._pipe = child, ours
        torch.set_num_threads(self._threads)

    def _make_slot(self) -> Slot:
        raw = torch.zeros(self._batch_size, self._spec.dtype.itemsize, dtype=torch.uint8)
        importance, norm = torch.ones(self._batch_size), torch.zeros(())
        with torch.no_grad():
            output = self._update.model_pass(view_batch(raw, importance, self._spec))[1]  # for its shapes and types
        metrics = {name: value.clone() for name, value in output.metrics.items()}
        model = ModelPass._make([*(part.clone() for part in output[:-1]), metrics])  # some are the update's own
        slot = Slot(raw, importance, torch.zeros(()), model, norm)
        _share([raw, norm, *model[:-1], *model.metrics.values()])
        return slot

    def _run_child(self, parent: int, requests: socket.socket) -> NoReturn:
        """In the new process, which ends with the other one, or once that closes its end."""
        try:
            exit_with_parent(parent)
            for one in (signal.SIGINT, signal.SIGTERM):  # the other one hears them
                signal.signal(one, signal.SIG_IGN)
            setproctitle.setproctitle(MODEL_PROCESS)
            _close_all_but(requests.fileno())
            while request := requests.recv(REQUEST.size, socket.MSG_WAITALL):
                number, threads, *plan = REQUEST.unpack(request)
                torch.set_num_threads(threads)
                self._model_half(self._slots[number % len(self._slots)], number, Plan(*plan))
                requests.sendall(b"\0")
        except ConnectionError:  # closed, with answers unread
            pass
        except BaseException:
            try:
                traceback.print_exc()
                sys.stderr.flush()
            finally:  # also where that fails, as on a full disk: else this would go on as the other one
                os._exit(1)
        os._exit(0)

    def _model_half(self, slot: Slot, number: int, plan: Plan) -> None:
        update, batch = self._update, view_batch(slot.raw, slot.importance, self._spec, plan)
        model, norm = update.train_model(batch)
        update.average.update(number, MODEL_PARTS)
        slot.write(batch, model, norm)


def _cut(place: Tensor, steps: int) -> Tensor:
    """(B, T, ...) -> (B, T - steps, ...), the beginning of its memory."""
    shape = (place.shape[0], place.shape[1] - steps, *place.shape[2:])
    return place.view(-1)[: math.prod(shape)].view(shape)


def _share(tensors: Iterable[Tensor]) -> None:
    """Move each into memory that a forked process has, too: anonymous, as a container's /dev/shm may be small."""
    tensors = list(tensors)
    sizes = [-(-tensor.nbytes // ALIGNMENT) * ALIGNMENT for tensor in tensors]
    block = torch.frombuffer(mmap.mmap(-1, sum(sizes)), dtype=torch.uint8)
    for tensor, part in zip(tensors, torch.split(block, sizes), strict=True):
        shared = part[: tensor.nbytes].view(tensor.dtype).view(tensor.shape)
        shared.copy_(tensor.detach())
        tensor.data = shared


def _close_all_but(kept: int) -> None:
    """What belongs to the other process: Redis, replay servers, locks."""
    os.closerange(3, kept)
    os.closerange(kept + 1, os.sysconf("SC_OPEN_MAX"))
