"""Half an hour at full speed, the ring full and wrapping: ``python -m tests.faults.soak [--tries 1]``."""

import time
from collections.abc import Iterator
from pathlib import Path

from tests.faults.loaded import WRAPPING, Loaded
from tests.faults.row import Row, at_length

MINUTES, SETTLED = 30.0, 10.0  # from which minute on nothing may grow
MOST_GROWTH, RATIO, RATIO_TOLERANCE = 0.02, 4.0, 0.02
LOOK_SECONDS = 5.0
Looks = list[dict[str, tuple[float, int]]]


def soak(tries: int, folder: Path, minutes: float = MINUTES, settled: float = SETTLED) -> Iterator[Row]:
    """So often. Memory is the median of the last looks against that of the first after it has settled."""
    for number in range(tries):
        with Loaded(folder / f"run-{number}", *WRAPPING) as run:
            run.begin()
            looks = watch(run, 60 * minutes, 60 * settled)
            ratio, updates = run.newest("replay", "replay_ratio"), run.newest("learner", "updates")
            fill = run.newest("replay", "ring_fill")
            found = run.end()
        growth, files = memory_growth(looks), files_growth(looks)
        passed = not (found.lost or found.duplicated or max(files.values())) and fill == 1.0
        passed = passed and max(growth.values()) < MOST_GROWTH and abs(ratio / RATIO - 1) < RATIO_TOLERANCE
        facts = {f"{role}_grew": round(share, 4) for role, share in growth.items()}
        facts |= {"files_grew": max(files.values()), "replay_ratio": round(ratio, 3), "updates": updates}
        yield Row(
            f"soak, {minutes:.0f} minutes", tries, passed, found.acknowledged, found.lost, found.duplicated, None, facts
        )


def watch(run: Loaded, seconds: float, settled: float) -> Looks:
    """Looks at what is held, from ``settled`` on."""
    time.sleep(settled)
    looks, end = Looks(), time.monotonic() + seconds - settled
    while time.monotonic() < end:
        looks.append(run.held())
        time.sleep(LOOK_SECONDS)
    return looks


def memory_growth(looks: Looks) -> dict[str, float]:
    """By role, from the first tenth of the looks to the last, as a share."""
    few = max(1, len(looks) // 10)
    return {role: _middle(looks[-few:], role) / _middle(looks[:few], role) - 1 for role in looks[0]}


def _middle(looks: Looks, role: str) -> float:
    return sorted(look[role][0] for look in looks)[len(looks) // 2]


def files_growth(looks: Looks) -> dict[str, int]:
    """By role: fewest files open in the last tenth, less the fewest in the first."""
    few = max(1, len(looks) // 10)
    fewest = [{role: min(look[role][1] for look in part) for role in looks[0]} for part in (looks[:few], looks[-few:])]
    return {role: fewest[1][role] - fewest[0][role] for role in looks[0]}


if __name__ == "__main__":
    at_length(__doc__, 1, soak)
