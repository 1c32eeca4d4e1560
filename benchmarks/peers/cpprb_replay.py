"""cpprb under mixed load in the learner's process: batches a second drawn by priority, windows coming in.

python cpprb_replay.py CORE O A H COUNT BATCH RATE CHUNK
"""

import sys
import time

import numpy as np
from cpprb import PrioritizedReplayBuffer
from turns import pin, take_turns
from windows import Sizes, random_columns

EXPONENT, IMPORTANCE = 0.6, 0.4


def main() -> None:
    core, observation, action, hidden, count, batch, rate, chunk = map(int, sys.argv[1:])
    pin(core)
    columns = random_columns(Sizes(observation, action, hidden), count)
    fields = {name: {"shape": part.shape[1:], "dtype": part.dtype} for name, part in columns.items()}
    buffer = PrioritizedReplayBuffer(count, fields, alpha=EXPONENT)
    buffer.add(**columns)
    entry = {name: part[:chunk].copy() for name, part in columns.items()}
    del columns
    rng = np.random.default_rng(0)

    def one() -> None:
        sample = buffer.sample(batch, beta=IMPORTANCE)
        buffer.update_priorities(sample["indexes"], rng.uniform(0.1, 1.0, batch).astype(np.float32))

    def measure(seconds: float) -> float:
        begin, done, added = time.perf_counter(), 0, 0
        while (elapsed := time.perf_counter() - begin) < seconds:
            if added * chunk < rate * elapsed:
                buffer.add(**entry)
                added += 1
            one()
            done += 1
        return done / (time.perf_counter() - begin)

    take_turns(measure)


if __name__ == "__main__":
    main()
