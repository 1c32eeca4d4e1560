"""A learner ten times slower, and one that stands still: ``python -m tests.faults.slow_learner [--tries 1]``."""

from collections.abc import Iterator
from pathlib import Path
from statistics import mode

from rmc.common.bus.protocol import METRICS_KEPT
from tests.faults.loaded import ACTORS, Loaded
from tests.faults.row import Row, at_length
from tests.faults.soak import LOOK_SECONDS, MOST_GROWTH, memory_growth, watch

MINUTES = 10.0
SETTLE_SECONDS = 1800.0  # at most, until Redis keeps as many metrics as it ever will: a slow learner says few
SLOWER = 10.0
OTHERS = ("replay", "evaluator", *(f"actor-{actor}" for actor in range(ACTORS)))


def slow_down(tries: int, folder: Path) -> Iterator[Row]:
    """So often, both."""
    for number in range(tries):
        with Loaded(folder / f"slow-{number}") as run:
            run.begin()
            run.slow_down(SLOWER)
            settle(run, "learner", *OTHERS)
            yield judged("learner 10 times slower", run, 60 * MINUTES)
        with Loaded(folder / f"stopped-{number}") as run:
            run.begin()
            learner = run.process_of("learner")
            learner.suspend()
            settle(run, *OTHERS)
            yield judged("learner stopped", run, 60 * MINUTES)
            learner.resume()


def settle(run: Loaded, *roles: str) -> None:
    """Wait until Redis has as many metrics of each as it keeps."""
    run.until(lambda: all(len(run.records(role)) > METRICS_KEPT for role in roles), SETTLE_SECONDS)


def judged(fault: str, run: Loaded, seconds: float, most_growth: float = MOST_GROWTH) -> Row:
    """Whether memory stays as it is, while the actors wait at their credit."""
    growth = memory_growth(watch(run, seconds, 0.0, min(LOOK_SECONDS, seconds / 7)))
    waits = {_waits_for(run, f"actor-{actor}") for actor in range(ACTORS)}
    replay = _waits_for(run, "replay")
    passed = max(growth.values()) < most_growth and waits == {"credit"} and replay == "draws"
    facts: dict[str, float | int | str] = {f"{role}_grew": round(share, 4) for role, share in growth.items()}
    facts |= {"actors_wait_for": " ".join(sorted(waits)), "replay_waits_for": replay}
    return Row(f"{fault}, {seconds / 60:.0f} minutes", 1, passed, found=facts)


def _waits_for(run: Loaded, role: str) -> str:
    """What it waited for in most of its last seconds."""
    return mode(record["waiting_for"] for record in run.records(role)[-5:])


if __name__ == "__main__":
    at_length(__doc__, slow_down, tries=1)
