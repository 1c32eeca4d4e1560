"""Windows a second that a client on one core puts into a Reverb server on another, confirmed by it.

python reverb_ingest.py LAYOUT CORE SERVER_CORE O A H COUNT CHUNK
"""

import os
import sys
import time

from reverb_replay import start
from reverb_table import Writer, columns_of
from turns import take_turns
from windows import Sizes


def main() -> None:
    layout, *numbers = sys.argv[1:]
    core, server_core, observation, action, hidden, count, chunk = map(int, numbers)
    sizes = Sizes(observation, action, hidden)
    os.sched_setaffinity(0, {server_core})
    server = start("reverb_table", *sizes, count, layout)
    port = int(server.stdout.readline())
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), {core})
    writer = Writer(port, columns_of(sizes, 1024, layout))
    writer.write(count)

    def measure(seconds: float) -> float:
        begin, done = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds:
            writer.write(chunk, wait=False)
            done += chunk
        writer.wait()
        return done / (time.perf_counter() - begin)

    take_turns(measure)


if __name__ == "__main__":
    main()
