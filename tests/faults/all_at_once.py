"""All faults at once, from a seed: ``python -m tests.faults.all_at_once --hours 1 --seed 0``, or ``make chaos``.

Roles, Redis, the launcher and a whole node (launcher, roles and Redis: all that one machine has of it) are killed;
they stand still; Redis and the replay server are behind bad networks; disks are full, files damaged. The schedule
follows from the seed: ``schedule.py``. A ring of few windows wraps. Then all is calm, the run goes on to its end, and
its last policy must play nearly as well as can be. Each fault is a line of ``--log``. Linux and root.
"""

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import pairwise, takewhile
from pathlib import Path

import psutil

from rmc.deploy.run.folder import RunFolder
from tests.faults.chaos import RATIO, Chaos
from tests.faults.disk_full import small_disk
from tests.faults.judge import judge_rows
from tests.faults.kill_redis import logged_redis
from tests.faults.row import Row
from tests.faults.schedule import EACH_ACTOR, schedule
from tests.faults.soak import RATIO_TOLERANCE, files_growth, memory_growth
from tests.faults.witness import went_back
from tests.processes import alive

GAP_SECONDS = 3.5  # between the beginnings of faults, on average
CALM_SHARE = 0.1  # steps without faults at the end, for one before
DISK_MB, DISK_MB_AN_HOUR = 400, 400  # metrics and events grow; a start wants 268 free
MOST_GROWTH = 0.05  # of a role's memory, over all of its lives
CONNECTIONS = 3  # of a role that lacks some while a fault has cut them, as at the end nothing has
BEST_RETURN, LEAST_RETURN = 4.0, 0.8  # of the task; the share of it that a run of half an hour has learnt


@contextmanager
def chaos(place: Path, log: Path, megabytes: int) -> Iterator[Chaos]:
    """Begun, on disks of its own."""
    with ExitStack() as leave:
        disks = {name: leave.enter_context(small_disk(place / f"{name}-disk", megabytes)) for name in ("run", "log")}
        (disks["run"] / "run").mkdir()
        (place / "run").symlink_to(disks["run"] / "run")  # what it prints goes elsewhere
        redis = leave.enter_context(logged_redis(disks["log"] / "redis", place / "redis.said"))
        one = leave.enter_context(closing(Chaos(place, redis, disks, log)))
        one.begin()
        yield one


def judged(one: Chaos, name: str, back: float) -> Row:
    """Of a run that has ended. ``back``: seconds from its last fault until all went on."""
    ledger = one.ledger
    ledger.look()
    verdict = judge_rows(ledger.rows(), one.witness.acks, full=False)
    never = {
        "windows_out_of_order": ledger.disordered(),
        "windows_not_seen": ledger.missed,
        "replay_epochs_went_back": ledger.epochs_went_back,
        "acks_went_back": one.witness.acks_went_back,
        "weights_went_back": one.weights_went_back + went_back(one.witness.versions),
        "ended_unexpectedly": len(one.unexpected),
        "left_behind": len(left_behind(one)),
    }
    ratio = [record["replay_ratio"] for record in RunFolder(one.folder).records() if "replay_ratio" in record][-1]
    print(*one.unexpected, *left_behind(one), sep="\n", file=sys.stderr)
    facts = {**never, **happened(one), **noticed(one.folder), "replay_ratio": round(ratio, 3)}
    return Row.judged(name, one.happened.total(), not any(never.values()), verdict, back, facts)


def is_held(one: Chaos, ratio: float) -> bool:
    """Whether that is the run's replay ratio, but for what actors may be ahead of it."""
    config = RunFolder(one.folder).config()
    ahead = config.slack_steps() / (one.ledger.env_steps - config.replay.warmup_steps)
    return abs(ratio / RATIO - 1) < RATIO_TOLERANCE + ahead


def noticed(folder: Path) -> dict[str, int]:
    """Of damage to files."""
    seen = [record["damaged_windows"] for record in RunFolder(folder).records() if "damaged_windows" in record]
    older = (folder / "logs" / "learner.log").read_text().count("it is passed over")
    more = sum(max(0, later - earlier) for earlier, later in pairwise([0, *seen]))  # each server counts from 0
    return {"damaged windows noticed": more, "damaged checkpoints noticed": older}


def happened(one: Chaos) -> dict[str, int]:
    """How many of which faults, those of actors together."""
    counts: dict[str, int] = {}
    for (kind, target), number in sorted(one.happened.items()):
        name = f"{kind}, {'actors' if target in EACH_ACTOR else target}"
        counts[name] = counts.get(name, 0) + number
    cuts = {
        "connections of Redis cut": one.redis_proxy.cuts,
        "connections of the replay server cut": one.replay_proxy.cuts,
    }
    kills = sum(number for (kind, _), number in one.happened.items() if kind.startswith("kill"))
    return {"kills": kills, **counts, **cuts, "starts refused": one.refused_starts}


def left_behind(one: Chaos) -> list[str]:
    """Processes of its launchers, and their folders of sockets."""
    named = [process for process in psutil.process_iter(["cmdline"]) if RunFolder(one.folder).name in _words(process)]
    folders = [path for pid in one.launchers for path in Path(tempfile.gettempdir()).glob(f"rmc-sockets-{pid}-*")]
    return [*map(str, alive(named)), *map(str, folders)]


def _words(process: psutil.Process) -> list[str]:
    return process.info["cmdline"] or []


def flat(one: Chaos) -> tuple[bool, dict[str, float]]:
    """Whether memory and open files stay as they are from a role's first lives to its last, and how they grew."""
    grew = {role: round(memory_growth(looks)[role], 4) for role, looks in one.looks.items() if looks}
    files = {role: files_growth(looks)[role] for role, looks in one.looks.items() if looks}
    facts = {f"{role} grew": share for role, share in grew.items()} | {"files grew": max(files.values(), default=0)}
    return max(grew.values(), default=0.0) < MOST_GROWTH and facts["files grew"] <= CONNECTIONS, facts


def learnt(folder: Path) -> tuple[float, int]:
    """The return of the policy that a run ended with, and its updates."""
    result = RunFolder(folder).result()
    if result is None:  # it could not be trained to its end
        return float("-inf"), 0
    return round(float(result["eval_return_mean"]), 2), int(result["updates"])


def main() -> None:
    """A row; ends with 1 if it failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0, help="of faults")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", type=Path, help="by default build/chaos-SEED.jsonl")
    options = parser.parse_args()
    log = options.log or Path("build") / f"chaos-{options.seed}.jsonl"
    log.parent.mkdir(exist_ok=True)
    seconds, name = 3600 * options.hours, f"all at once, {60 * options.hours:.0f} minutes, seed {options.seed}"
    faults = takewhile(lambda fault: fault.at < seconds, schedule(options.seed, GAP_SECONDS))
    with tempfile.TemporaryDirectory(prefix="rmc-fault-") as folder:
        place = Path(folder)
        with chaos(place, log, int(DISK_MB + DISK_MB_AN_HOUR * options.hours)) as one:
            one.suffer(faults, seconds)
            back = one.until_all_go_on()
            one.stop()
            steps = one.end(CALM_SHARE)
            row = judged(one, name, back)
            is_flat, growth = flat(one)
            returned, updates = learnt(one.folder)
            held = is_held(one, row.found["replay_ratio"])  # after the calm part: faults hold draws up
    passed = row.passed and held and is_flat and returned >= LEAST_RETURN * BEST_RETURN
    learning = {"steps": steps, "updates": updates, "return": returned}
    dataclasses.replace(row, passed=passed, found={**row.found, **growth, **learning}).keep()
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()
