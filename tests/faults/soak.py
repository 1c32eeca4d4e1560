"""At full speed, the ring full and wrapping: ``python -m tests.faults.soak [--minutes 80]``."""

import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from scipy.stats import theilslopes

from tests.faults.loaded import WRAPPING, Loaded
from tests.faults.row import Row, at_length

SETTLED_SECONDS = 1800.0  # from then on nothing may grow: Redis needs 20 minutes; of a shorter soak the second half
MOST_GROWTH, RATIO, RATIO_TOLERANCE = 0.02, 4.0, 0.02
LOOK_SECONDS = 5.0
FEW_LOOKS = 3  # at either end of a short soak: a file may just be open for being written
Looks = list[dict[str, tuple[float, int]]]


def soak(minutes: int, folder: Path) -> Iterator[Row]:
    """One run."""
    with Loaded(folder / "run", *WRAPPING) as run:
        run.begin()
        row = soaked(run, 60 * minutes, min(SETTLED_SECONDS, 30 * minutes))
        yield row.with_verdict(run.end())


def soaked(
    run: Loaded,
    seconds: float,
    settled: float,
    most_growth: float = MOST_GROWTH,
    off: float = RATIO_TOLERANCE,
    every: float = LOOK_SECONDS,
) -> Row:
    """Whether memory and open files stay as they are after ``settled`` seconds, the ring full and the ratio held.

    ``off``: how far it may be, as a share; soon after the start what actors may hold back is more of it.
    ``every``: seconds between looks.
    """
    looks = watch(run, seconds, settled, every)
    growth, files = memory_growth(looks), max(files_growth(looks).values())
    ratio, full = run.newest("replay", "replay_ratio"), run.newest("replay", "ring_fill") == 1.0
    passed = max(growth.values()) < most_growth and files <= 0 and full and abs(ratio / RATIO - 1) < off
    facts = {f"{role}_grew": round(share, 4) for role, share in growth.items()}
    facts |= {"files_grew": files, "replay_ratio": round(ratio, 3), "updates": run.newest("learner", "updates")}
    return Row(f"soak, {seconds / 60:.0f} minutes", 1, passed, found=facts)


def watch(run: Loaded, seconds: float, settled: float, every: float) -> Looks:
    """Looks at what is held, from ``settled`` to the end; on a slow machine on until there are enough."""
    time.sleep(settled)
    end, looks = time.monotonic() + seconds - settled, [run.held()]
    while (left := end - time.monotonic()) > 0 or len(looks) < 2 * FEW_LOOKS:
        time.sleep(left if 0 < left < every else every)
        looks.append(run.held())
    return looks


def memory_growth(looks: Looks) -> dict[str, float]:
    """By role, from the first look to the last, as a share: by the median of the slopes between any two looks.

    Redis swings by a tenth with what passes through it, so few looks at either end tell little.
    """
    if len(looks) < 2:
        return dict.fromkeys(looks[0], 0.0)
    held = {role: [look[role][0] for look in looks] for role in looks[0]}
    return {role: float(theilslopes(mb).slope) * (len(mb) - 1) / median(mb) for role, mb in held.items()}


def files_growth(looks: Looks) -> dict[str, int]:
    """By role: fewest files open in the last tenth, less the fewest in the first."""
    few = max(FEW_LOOKS, len(looks) // 10)
    assert len(looks) >= 2 * few, "the first looks are the last ones, too"
    fewest = [{role: min(look[role][1] for look in part) for role in looks[0]} for part in (looks[:few], looks[-few:])]
    return {role: fewest[1][role] - fewest[0][role] for role in looks[0]}


if __name__ == "__main__":
    at_length(__doc__, soak, minutes=80)
