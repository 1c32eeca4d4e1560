"""The update on its device: rows in, priorities out, the batch always in the same memory.

A GPU must never wait for the host: an update launches some 500 kernels of some microseconds each, so they are recorded
as one CUDA graph for each plan, and copies go beside it. A CPU takes the same way, without a graph. Shapes: B batch.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from rmc.common.window import WindowSpec
from rmc.learner.batch import Plan, view_batch
from rmc.learner.update import JointUpdate, UpdateResult

T = TypeVar("T")
WARM_UP = 3  # calls as they are, in which libraries choose their kernels and Adam makes its moments


class GraphPlace(NamedTuple):
    """Where graphs are recorded, one after the other."""

    stream: torch.cuda.Stream  # the default one cannot be recorded
    pool: Any  # of memory

    @classmethod
    def on(cls, device: torch.device) -> "GraphPlace":
        return cls(torch.cuda.Stream(device), torch.cuda.graph_pool_handle())  # type: ignore[no-untyped-call]


class CudaGraph(Generic[T]):
    """A function of tensors that stay where they are: recorded once, after some calls as it is, and replayed."""

    def __init__(self, work: Callable[[], T], generator: torch.Generator, place: "GraphPlace") -> None:
        """``generator`` gives ``work`` its random numbers; a replay takes those after the last one's.

        Graphs of one ``place`` overwrite each other's results.
        """
        self._work, self._generator, self._place, self._warm_up = work, generator, place, WARM_UP
        self._graph: torch.cuda.CUDAGraph | None = None
        self._recorded: T | None = None

    def __call__(self) -> T:
        """What ``work`` returns; the next call overwrites it."""
        if self._warm_up:
            self._warm_up -= 1
            return self._as_it_is()
        if self._graph is None:
            self._record()
        assert self._graph is not None
        assert self._recorded is not None
        self._graph.replay()
        return self._recorded

    def _as_it_is(self) -> T:
        current = torch.cuda.current_stream(self._generator.device)
        stream = self._place.stream
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            result = self._work()
        current.wait_stream(stream)
        return result

    def _record(self) -> None:
        """Nothing is computed yet: the first replay does that."""
        self._graph = torch.cuda.CUDAGraph()
        self._graph.register_generator_state(self._generator)
        with torch.cuda.graph(self._graph, self._place.pool, self._place.stream):
            self._recorded = self._work()


class CopiesAhead:
    """Tensors from pinned memory to their places on the device, on the way while the device still works on the last."""

    def __init__(self, places: list[Tensor]) -> None:
        self._places, self._device = places, places[0].device
        self._landed = [torch.empty_like(place) for place in places]
        self._stream = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        self._consumed = torch.cuda.Event()  # type: ignore[no-untyped-call]

    def __call__(self, tensors: list[Tensor]) -> None:
        """What is launched after this finds them there; what was launched before still finds the last."""
        current = torch.cuda.current_stream(self._device)
        self._stream.wait_event(self._consumed)
        with torch.cuda.stream(self._stream):
            for landed, tensor in zip(self._landed, tensors, strict=True):
                landed.copy_(tensor, non_blocking=True)
        current.wait_stream(self._stream)
        for place, landed in zip(self._places, self._landed, strict=True):
            place.copy_(landed)
        self._consumed.record(current)


class HostCopy:
    """A tensor on its way to the host."""

    def __init__(self, tensor: Tensor) -> None:
        self._host, self._there = tensor, None
        if tensor.is_cuda:
            self._host = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            self._host.copy_(tensor, non_blocking=True)
            self._there = torch.cuda.current_stream(tensor.device).record_event()

    def wait(self) -> Tensor:
        """It, once it is there."""
        if self._there is not None:
            self._there.synchronize()
        return self._host


class DeviceUpdate:
    """An update of batches of one size. A checkpoint must be taken up before the first call, not after."""

    def __init__(self, update: JointUpdate, spec: WindowSpec, batch_size: int) -> None:
        device = update.agent.log_alpha.device
        self._update, self._spec = update, spec
        self._raw = torch.zeros(batch_size, spec.dtype.itemsize, dtype=torch.uint8, device=device)
        self._importance, self._beta = torch.ones(batch_size, device=device), torch.zeros((), device=device)
        self._work: Callable[[Plan], UpdateResult] = self._once
        self._copy, self.in_flight = self._copy_now, 0
        if device.type == "cuda":
            self._graphs: dict[Plan, CudaGraph[UpdateResult]] = {}
            self._place = GraphPlace.on(device)
            self._beside = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
            self._work, self._copy, self.in_flight = self._replay, CopiesAhead([self._raw, self._importance]), 1

    def __call__(self, raw: Tensor, importance: Tensor, beta: float, number: int) -> list[UpdateResult]:
        """(B, row bytes) uint8 whose padding is zero, (B,) float32, and the update's number; its result, which the next
        call overwrites.

        On a GPU this only launches. ``raw`` may be written again once the update's priorities are on the host.
        """
        self._copy([raw, importance])
        self._beta.fill_(beta)
        result = self._work(self._update.plan(raw, self._spec, number))
        self._update.average.update(number)
        return [result]

    def use_threads(self, number: int) -> None:
        """So many, where it runs on a CPU."""
        torch.set_num_threads(number)

    def drain(self) -> list[UpdateResult]:
        """Nothing is pending."""
        return []

    def close(self) -> None:
        """Nothing is to be ended."""

    def _once(self, plan: Plan) -> UpdateResult:
        return self._update(view_batch(self._raw, self._importance, self._spec, plan), self._beta)

    def _halves_at_once(self, plan: Plan) -> UpdateResult:
        """Where nothing flows back to memory and world model, their way back goes beside critics and policy.

        What both streams read is held until they meet: memory that one gave up would go to the other.
        """
        update, batch = self._update, view_batch(self._raw, self._importance, self._spec, plan)
        current = torch.cuda.current_stream(self._raw.device)
        model_losses, model = update.model_pass(batch)
        self._beside.wait_stream(current)
        with torch.cuda.stream(self._beside):
            actor_critic, actor_critic_norm = update.train_actor_critic(batch, model, self._beta)
        model_norm = update.step(update.optimizers[:1], model_losses.values())
        update.after_model_step(model)
        current.wait_stream(self._beside)
        return update.result(batch, model, actor_critic, torch.hypot(model_norm, actor_critic_norm))

    def _replay(self, plan: Plan) -> UpdateResult:
        """Each plan has a graph of its own."""
        if plan not in self._graphs:
            work = self._halves_at_once if self._update.config.halves_are_apart() else self._once
            self._graphs[plan] = CudaGraph(partial(work, plan), self._update.generator, self._place)
        return self._graphs[plan]()

    def _copy_now(self, tensors: list[Tensor]) -> None:
        for place, tensor in zip((self._raw, self._importance), tensors, strict=True):
            place.copy_(tensor)
