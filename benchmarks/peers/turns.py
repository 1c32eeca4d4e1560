"""What the peers' scripts share with ours: turns as ``benchmarks/harness.py`` asks for them, a speed, a clock."""

import json
import os
import sys
import time
from collections.abc import Callable


def take_turns(measure: Callable[[float], float]) -> None:
    """Say that we are ready, then measure once for each line of standard input, the seconds to measure for."""
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        print(json.dumps({"value": measure(float(line))}), flush=True)


def speed(work: Callable[[], int], seconds: float) -> float:
    """Units of work a second, ``work`` returning how many it did."""
    done, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        done += work()
    return done / (time.perf_counter() - start)


def pin(core: int) -> None:
    """This process, and all that it starts, on one core."""
    os.sched_setaffinity(0, {core})


def send_at(rate: float, chunk: int, seconds: float, send: Callable[[], None]) -> float:
    """Call ``send`` for ``chunk`` windows on a clock; what came of ``rate`` windows a second."""
    start, sent = time.perf_counter(), 0
    while (now := time.perf_counter() - start) < seconds:
        due = sent * chunk / rate
        if now < due:
            time.sleep(min(due - now, seconds - now))
            continue
        send()
        sent += 1
    return sent * chunk / (time.perf_counter() - start)
