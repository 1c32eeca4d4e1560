"""kill -9 of the replay server under load: ``python -m tests.faults.kill_replay [--tries 20]``.

At random and at every commit point, its ring full and wrapping; with 100 000 windows.
"""

import random
import time
from collections.abc import Iterator
from pathlib import Path

from tests.faults.loaded import FILL_SECONDS, WRAPPING, Loaded
from tests.faults.row import Row, at_length

RECOVERY_S = 10.0
POINTS = (
    "read", "record", "half-the-rows", "rows", "priorities", "half-a-record", "committed", "acknowledged", "drawn",
)  # fmt: skip
LARGE = ("--capacity", "100000", "--replay-ratio", "0.05")  # so that it fills within minutes


def kill_replays(tries: int, folder: Path) -> Iterator[Row]:
    """At random moments, then at each point."""
    chance, slowest = random.Random(0), 0.0
    with Loaded(folder / "run", *WRAPPING) as run:
        run.begin()
        run.until(lambda: run.newest("replay", "ring_fill") == 1.0, FILL_SECONDS)
        for _ in range(tries):
            time.sleep(chance.uniform(0.2, 1.5))
            slowest = max(slowest, run.kill("replay"))
            run.until_all_go_on()
            tree_is_its_rebuild(run)
        yield _row("kill -9 of the replay server at random", run, tries, slowest)
    with Loaded(folder / "points", *WRAPPING) as run:
        run.begin()
        run.until(lambda: run.newest("replay", "ring_fill") == 1.0, FILL_SECONDS)
        slowest = strike_everywhere(run)
        yield _row("kill -9 of the replay server at every commit point", run, len(POINTS), slowest)


def strike_everywhere(run: Loaded) -> float:
    """At each point once, going on in between; the longest until it was back."""
    slowest = 0.0
    for point in POINTS:
        slowest = max(slowest, run.strike(point, "replay"))
        run.until_all_go_on()
    return slowest


def tree_is_its_rebuild(run: Loaded) -> bool:
    """Of the replay server that runs, and of all that were looked at before."""
    looks = len(run.events("tree"))
    run.arm("compare-tree")
    run.until(lambda: len(run.events("tree")) > looks)
    return all(look["same"] for look in run.events("tree"))


def kill_large(tries: int, folder: Path) -> Iterator[Row]:
    """With 100 000 windows in the ring."""
    slowest = 0.0
    with Loaded(folder / "large", *LARGE) as run:
        run.begin()
        run.until(lambda: run.newest("replay", "ring_fill") == 1.0, 580.0)
        for _ in range(tries):
            slowest = max(slowest, run.kill("replay"))
            run.until_all_go_on()
        yield _row("kill -9 of the replay server with 100 000 windows", run, tries, slowest)


def _row(fault: str, run: Loaded, tries: int, slowest: float) -> Row:
    is_rebuild = tree_is_its_rebuild(run)
    verdict = run.end()
    facts = {"entries_missed": len(run.events("gap")), "acks_went_back": run.witness.acks_went_back}
    passed = not any(facts.values()) and is_rebuild and slowest < RECOVERY_S
    facts |= {"trees_are_their_rebuild": len(run.events("tree")) if is_rebuild else 0}
    return Row.judged(fault, tries, passed, verdict, slowest, facts)


def all_of_them(tries: int, folder: Path) -> Iterator[Row]:
    """The three rows."""
    yield from kill_replays(tries, folder)
    yield from kill_large(3, folder)


if __name__ == "__main__":
    at_length(__doc__, all_of_them, tries=20)
