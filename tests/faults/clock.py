"""The clock moved by an hour, both ways: ``python -m tests.faults.clock [--tries 3]``.

Through a library that is loaded before all others, ``clock.c``: it needs a C compiler. The monotonic clock stays as it
is, as it does where a clock is moved.
"""

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tests.faults.loaded import Loaded
from tests.faults.row import Row, at_length
from tests.faults.witness import went_back

SOURCE = Path(__file__).with_name("clock.c")
HOUR, HOURS, SECONDS = 3600, (1, -1, 0), 3.0  # seconds of one, where to, and how long between moves


def move_clock(tries: int, folder: Path) -> Iterator[Row]:
    """An hour on, an hour back, so often, amid a run that goes on as it did."""
    slowest, hours = 0.0, []
    with Loaded(folder / "run", environment=other_clock(folder)) as run:
        run.begin()
        for _ in range(tries):
            for hour in HOURS:
                set_clock(folder, hour)
                slowest = max(slowest, run.until_all_go_on())
                time.sleep(SECONDS)
                hours.append(hours_away(run))
        restarts = run.newest("launcher", "restarts")
        verdict = run.end()
    facts = {
        "moves_seen_by_the_roles": sum(hour != 0 for hour in hours),
        "restarts": restarts,
        "weights_went_back": went_back(run.witness.versions),
    }
    passed = not (restarts or facts["weights_went_back"]) and hours == [*HOURS] * tries
    yield Row.judged("clock moved by an hour, both ways", 2 * tries, passed, verdict, slowest, facts)


def other_clock(folder: Path) -> dict[str, str]:
    """The environment of processes whose clock ``set_clock`` moves."""
    library = folder / "clock.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", library, SOURCE, "-ldl"], check=True)
    set_clock(folder, 0)
    return {"LD_PRELOAD": str(library), "CLOCK_FILE": str(folder / "clock")}


def set_clock(folder: Path, hours: int) -> None:
    """At once: it is read all the time."""
    new = folder / "clock.new"
    new.write_text(str(hours * HOUR))
    new.rename(folder / "clock")


def hours_away(run: Loaded) -> int:
    """How far the roles' clock is from this process's."""
    return round((run.newest("replay", "time") - time.time()) / HOUR)


if __name__ == "__main__":
    at_length(__doc__, move_clock, tries=3)
