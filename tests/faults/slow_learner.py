"""A learner ten times slower, and one that stands still: ``python -m tests.faults.slow_learner [--tries 1]``."""

from collections.abc import Iterator
from pathlib import Path
from statistics import mode

from tests.faults.loaded import ACTORS, Loaded
from tests.faults.row import Row, at_length
from tests.faults.soak import MOST_GROWTH, memory_growth, watch

MINUTES, SETTLED = 16.0, 6.0  # from when on Redis keeps as many metrics as it ever will
SLOWER = 10.0


def slow_down(tries: int, folder: Path, minutes: float = MINUTES, settled: float = SETTLED) -> Iterator[Row]:
    """So often, both."""
    for number in range(tries):
        with Loaded(folder / f"slow-{number}") as run:
            run.begin()
            run.slow_down(SLOWER)
            yield judged("learner 10 times slower", run, 60 * minutes, 60 * settled)
        with Loaded(folder / f"stopped-{number}") as run:
            run.begin()
            learner = run.process_of("learner")
            learner.suspend()
            yield judged("learner stopped", run, 60 * minutes, 60 * settled)
            learner.resume()


def judged(fault: str, run: Loaded, seconds: float, settled: float, most_growth: float = MOST_GROWTH) -> Row:
    """Whether memory stays as it is after ``settled`` seconds, while the actors wait at their credit."""
    growth = memory_growth(watch(run, seconds, settled))
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
    at_length(__doc__, 1, slow_down)
