"""A Reverb server with one prioritized table of whole windows, in this process or as one of its own.

python reverb_table.py O A H COUNT LAYOUT    prints its port
"""

import sys

import reverb
import tensorflow as tf
from windows import Columns, Sizes, pack, random_columns

TABLE = "windows"
EXPONENT = 0.6
AHEAD = 200  # windows that need not be confirmed yet


def columns_of(sizes: Sizes, count: int, layout: str) -> Columns:
    """Windows as columns, ``fields``, or as one column of bytes, ``packed``."""
    columns = random_columns(sizes, count)
    return pack(columns) if layout == "packed" else columns


def serve(sizes: Sizes, count: int, layout: str) -> reverb.Server:
    """A server of ``count`` windows, the oldest making room, without a limiter."""
    one = columns_of(sizes, 1, layout)
    table = reverb.Table(
        TABLE,
        sampler=reverb.selectors.Prioritized(EXPONENT),
        remover=reverb.selectors.Fifo(),
        max_size=count,
        rate_limiter=reverb.rate_limiters.MinSize(1),
        signature={name: tf.TensorSpec(part.shape[1:], part.dtype) for name, part in one.items()},
    )
    return reverb.Server([table])


class Writer:
    """Writes windows, each an item of one step, which is the whole sequence."""

    def __init__(self, port: int, columns: Columns) -> None:
        self._columns, self._count = columns, len(next(iter(columns.values())))
        self._writer = reverb.Client(f"localhost:{port}").trajectory_writer(num_keep_alive_refs=1)
        self._next = 0

    def write(self, count: int, wait: bool = True) -> None:
        """So many windows; return once the server has them, or all but the last few."""
        for _ in range(count):
            at, self._next = self._next, (self._next + 1) % self._count
            self._writer.append({name: part[at] for name, part in self._columns.items()})
            trajectory = {name: self._writer.history[name][-1] for name in self._columns}
            self._writer.create_item(TABLE, priority=1.0, trajectory=trajectory)
        self._writer.flush(0 if wait else AHEAD)

    def wait(self) -> None:
        """Until the server has all."""
        self._writer.flush()


if __name__ == "__main__":
    observation, action, hidden, count, layout = sys.argv[1:]
    server = serve(Sizes(int(observation), int(action), int(hidden)), int(count), layout)
    print(server.port, flush=True)
    server.wait()
