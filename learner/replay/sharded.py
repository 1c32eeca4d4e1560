"""Several replay servers as one: each gives its part of a batch, in proportion to the weight of its priorities.

Shapes: B windows in a batch, S shards. A window's chance is its weight over the total of all shards, as if one server
held them all: a shard's part of a batch is how many of B equal strata of the whole weight fall to it, and within it
the shard draws by its own weights. A total is that of a shard's newest draw. A new window enters with the largest
priority of its own shard. Serials become ``serial * S + shard``,
so that priorities find their way back.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from rmc.common.replay import EMPTY_SAMPLE, ObservationStatistics, Replay, Sample, SampleStatus
from rmc.common.window import Rows, WindowSpec, joined


class _Stock:
    """Windows that a shard has drawn and that are in no batch yet."""

    def __init__(self, replay: Replay, spec: WindowSpec, chunk: int) -> None:
        self.replay, self.last, self._spec = replay, EMPTY_SAMPLE, spec
        self._chunk = chunk  # windows of one draw
        self._rows: Rows = np.empty(0, spec.dtype)
        self._weights = np.empty(0)

    def fill(self, count: int, drawn_elsewhere_steps: int) -> SampleStatus:
        """Draw until there are ``count`` windows; else why there are not."""
        while len(self._rows) < count:
            self.last = self.replay.sample(self._chunk, drawn_elsewhere_steps)
            if self.last.rows is None or self.last.weights is None:
                return self.last.status
            self._rows = joined([self._rows, self.last.rows], self._spec)
            self._weights = np.concatenate([self._weights, self.last.weights])
        return SampleStatus.BATCH

    def take(self, rows: Rows, weights: NDArray[np.float64]) -> None:
        """Fill both with the oldest."""
        count = len(rows)
        rows[:], weights[:] = self._rows[:count], self._weights[:count]
        self._rows, self._weights = self._rows[count:], self._weights[count:]


class ShardedReplay:
    """The Replay protocol over S of them. A shard that holds back holds the batch back."""

    def __init__(
        self, shards: Sequence[Replay], spec: WindowSpec, batch_size: int, seed: int, pinned: bool = False
    ) -> None:
        """The shards are asked for B // S windows at a time."""
        self._batch_size, self._random = batch_size, np.random.default_rng(seed)
        self._stocks = [_Stock(shard, spec, max(1, batch_size // len(shards))) for shard in shards]
        size = (batch_size, spec.dtype.itemsize)
        tensors = [torch.empty(size, dtype=torch.uint8, pin_memory=pinned) for _ in range(2)]
        self._buffers: list[Rows] = [tensor.numpy().view(spec.dtype).reshape(-1) for tensor in tensors]
        self._parts: NDArray[np.int64] | None = None  # (S,) windows of each in the batch that is being gathered

    def register_learner(self, epoch: int) -> None:
        for stock in self._stocks:
            stock.replay.register_learner(epoch)

    def sample(self, batch_size: int, drawn_elsewhere_steps: int = 0) -> Sample:
        """A batch once every shard has given its part. ``rows`` stay valid until the next draw but one.

        Shards finish one after the other, within a batch or the last steps of an actor; the rest fill the batch then.
        """
        assert batch_size == self._batch_size, (batch_size, self._batch_size)
        while (live := self._live()).any():
            parts = live.astype(np.int64) if self._parts is None else self._parts  # one of each: totals are known then
            draws = (
                stock.fill(part, drawn_elsewhere_steps + self._drawn_outside(stock))
                for stock, part in zip(self._stocks, parts.tolist(), strict=True)
            )  # one that hangs holds the learner for seconds: no other is asked then
            status = next((draw for draw in draws if draw is not SampleStatus.BATCH), SampleStatus.BATCH)
            if status is SampleStatus.FINISHED:
                self._parts = None
            elif status is SampleStatus.WAIT:
                return self._sample(SampleStatus.WAIT)
            elif self._parts is None:
                self._parts = self._apportion(live)
            else:
                return self._gathered()
        return self._sample(SampleStatus.FINISHED)

    def _live(self) -> NDArray[np.bool_]:
        """(S,) which shards have not finished."""
        return np.array([stock.last.status is not SampleStatus.FINISHED for stock in self._stocks])

    def _drawn_outside(self, stock: _Stock) -> int:
        """Trained steps drawn from the other shards."""
        return sum(other.last.drawn_steps for other in self._stocks if other is not stock)

    def _apportion(self, live: NDArray[np.bool_]) -> NDArray[np.int64]:
        """(S,) how many of B strata of the whole weight fall to each shard."""
        ends = np.cumsum([stock.last.total_weight for stock in self._stocks] * live)
        strata = (np.arange(self._batch_size) + self._random.random(self._batch_size)) / self._batch_size
        owners = np.minimum(np.searchsorted(ends, strata * ends[-1], side="right"), len(ends) - 1)
        return np.bincount(owners, minlength=len(ends))

    def _gathered(self) -> Sample:
        assert self._parts is not None
        self._buffers.reverse()
        rows, weights, start = self._buffers[0], np.empty(self._batch_size), 0
        for shard, (stock, count) in enumerate(zip(self._stocks, self._parts.tolist(), strict=True)):
            part = slice(start, start + count)
            stock.take(rows[part], weights[part])
            rows["serial"][part] = rows["serial"][part] * len(self._stocks) + shard
            start += count
        self._parts = None
        return self._sample(SampleStatus.BATCH, rows, weights)

    def _sample(
        self, status: SampleStatus, rows: Rows | None = None, weights: NDArray[np.float64] | None = None
    ) -> Sample:
        last = [stock.last for stock in self._stocks]
        total_weight, env_steps, drawn_steps = (
            sum(getattr(sample, name) for sample in last) for name in ("total_weight", "env_steps", "drawn_steps")
        )
        return Sample(status, rows, weights, total_weight, env_steps, drawn_steps)

    def update_priorities(self, serials: NDArray[np.int64], priorities: NDArray[np.float32]) -> None:
        """Give priorities back to the shards that the windows came from."""
        for shard, stock in enumerate(self._stocks):
            of_shard = serials % len(self._stocks) == shard
            stock.replay.update_priorities(serials[of_shard] // len(self._stocks), priorities[of_shard])

    def statistics(self) -> ObservationStatistics | None:
        """The sums over all shards; None while one is away."""
        total = self._stocks[0].replay.statistics()
        for stock in self._stocks[1:]:
            if total is None or (of_shard := stock.replay.statistics()) is None:
                return None
            total += of_shard
        return total

    def episode(self, serial: int) -> Rows | None:
        """The windows of one episode, which are all in one shard."""
        shards = len(self._stocks)
        return self._stocks[serial % shards].replay.episode(serial // shards)
