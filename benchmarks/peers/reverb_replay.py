"""Reverb under mixed load on one core: batches a second drawn by priority, priorities sent back, windows coming in.

    python reverb_replay.py PLACE LAYOUT IN_FLIGHT CORE O A H COUNT BATCH RATE CHUNK

PLACE: ``server`` (a process of its own) or ``learner`` (in the learner's process).
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import reverb
import tensorflow as tf
from reverb_table import TABLE, Writer, columns_of, serve
from turns import pin, speed, take_turns
from windows import Columns, Sizes, random_columns, unpack

IMPORTANCE = 0.4
KEPT_UP = 0.95  # of the windows offered
HERE = Path(__file__).parent
Batch = tuple[np.ndarray, np.ndarray, int, Columns]  # keys, probabilities, windows, columns


def start(script: str, *words: object) -> subprocess.Popen[str]:
    """Another script of this folder, which says on a line of its own that it is there."""
    command = [sys.executable, str(HERE / f"{script}.py"), *map(str, words)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def read_dataset(port: int, batch: int, in_flight: int) -> Iterator[Batch]:
    """Batches made by tf.data, which is faster than stacking the client's samples."""
    dataset = reverb.TrajectoryDataset.from_table_signature(
        f"localhost:{port}", TABLE, max_in_flight_samples_per_worker=in_flight
    ).batch(batch, drop_remainder=True)
    for info, data in dataset:
        columns = {name: part.numpy() for name, part in data.items()}
        yield info.key.numpy(), info.probability.numpy(), int(info.table_size[0]), columns


def main() -> None:
    place, layout, *numbers = sys.argv[1:]
    in_flight, core, observation, action, hidden, count, batch, rate, chunk = map(int, numbers)
    sizes = Sizes(observation, action, hidden)
    pin(core)
    tf.config.threading.set_intra_op_parallelism_threads(1)
    tf.config.threading.set_inter_op_parallelism_threads(1)
    if place == "server":
        server = start("reverb_table", *sizes, count, layout)
        port = int(server.stdout.readline())
    else:
        server = serve(sizes, count, layout)
        port = server.port
    Writer(port, columns_of(sizes, min(count, 1024), layout)).write(count)
    sender = start("reverb_sender", port, *sizes, layout, rate, chunk)
    sender.stdout.readline()
    like, client = random_columns(sizes, 1), reverb.Client(f"localhost:{port}")
    batches, rng = read_dataset(port, batch, in_flight), np.random.default_rng(0)

    def one() -> int:
        keys, probabilities, windows, columns = next(batches)
        if layout == "packed":
            columns = unpack(columns["row"], like)
        weights = (windows * probabilities) ** -IMPORTANCE
        weights = (weights / weights.max()).astype(np.float32)
        priorities = rng.uniform(0.1, 1.0, batch)
        client.mutate_priorities(TABLE, dict(zip(keys.tolist(), priorities.tolist(), strict=True)))
        return 1

    def measure(seconds: float) -> float:
        print(seconds + 0.2, file=sender.stdin, flush=True)
        batches_per_s = speed(one, seconds)
        came = json.loads(sender.stdout.readline())["value"]
        if came < KEPT_UP * rate:
            raise RuntimeError(f"only {came:.0f} of {rate} windows a second came in")
        return batches_per_s

    one()
    take_turns(measure)


if __name__ == "__main__":
    main()
