"""Wall time from the command to a policy of 2 000 and one of 4 000 on HalfCheetah, beside SAC in JAX.

    python -m benchmarks.end_to_end [--env ENV] [--goals 2000 4000] [--seeds 1 2 3] [--every 5000]

A goal is reached at the second of two consecutive evaluations above it, each of 5 deterministic episodes, every 5 000
environment steps; the clock starts with the process. Ours is ``rmc train`` as it comes. SBX's SAC makes 10 000 random
steps before the first update, as in rl-baselines3-zoo, and then 32 updates every 32 steps. Each has all cores for
itself, one run after another.
What results/end-to-end.jsonl has already is not run again: an interrupted benchmark goes on where it was.
"""

import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import pairwise, product
from pathlib import Path

from benchmarks import PEER_ENVIRONMENT
from benchmarks.harness import HERE, Row, argument_parser, command, peer_python, save
from rmc.deploy.run.metrics_tail import MetricsTail

CURVES = HERE / "results" / "end-to-end.jsonl"
EPISODES = 5
LIMIT_SECONDS = 3600.0
LARGEST_GOAL = 4000.0  # of curves that do not say theirs, too
PEER = "SBX SAC, 32 updates a call"
PACE = ("--together", "32", "--starts", "10000", "--episodes", str(EPISODES))  # random steps as in rl-baselines3-zoo
Point = tuple[float, float]  # seconds since the command, return


def ours(env: str, seed: int, every: int) -> Iterator[Point]:
    """A run's evaluations as they come; closing it ends the run."""
    with tempfile.TemporaryDirectory() as folder:
        run, began = Path(folder) / "run", time.time()
        words = ["train", env, "--seed", str(seed), "--total-steps", "1000000", "--run-dir", str(run)]
        process = _started([sys.executable, "-m", "rmc.cli.main", *words, "--checkpoint-steps", str(every)])
        try:
            tail = MetricsTail(run / "metrics.jsonl")
            while process.poll() is None:
                for record in tail.take():
                    if "eval_return_mean" in record:
                        yield record["time"] - began, record["eval_return_mean"]
                time.sleep(0.1)
            sys.exit(f"ours: rmc train has ended by itself, with status {process.wait()}")
        finally:
            _end(process)


def sbx(python: Path, env: str, seed: int, every: int) -> Iterator[Point]:
    """The same of the peer, which prints a line for each."""
    began, script = time.time(), str(HERE / "peers" / "sbx_run.py")
    process = _started([str(python), script, "SAC", env, str(seed), "--every", str(every), *PACE])
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if line.startswith("{"):
                yield time.time() - began, json.loads(line)["return"]
        sys.exit(f"{PEER}: it ended by itself, with status {process.wait()}; make peers installs what it needs")
    finally:
        _end(process)


def _started(words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=PEER_ENVIRONMENT)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(60)
    process.kill()


def reached(points: list[Point], goal: float) -> float | None:
    """When two evaluations in a row were above it."""
    for (_, before), (seconds, after) in pairwise(points):
        if min(before, after) > goal:
            return seconds
    return None


def run(points: Iterator[Point], goals: list[float]) -> list[Point]:
    """Until the last goal is reached, or an hour has gone."""
    curve: list[Point] = []
    for point in points:
        curve.append(point)
        print(f"  {point[0]:6.0f} s {point[1]:8.0f}", flush=True)
        if reached(curve, max(goals)) is not None or point[0] > LIMIT_SECONDS:
            break
    points.close()  # type: ignore[attr-defined]
    return curve


def _saved_curve(key: dict[str, object], goal: float) -> list[Point] | None:
    """One that was not cut at a lower goal, if there is one."""
    for line in CURVES.read_text().splitlines() if CURVES.exists() else []:
        row = json.loads(line)
        if row.get("goal", LARGEST_GOAL) >= goal and all(row[name] == value for name, value in key.items()):
            return [(seconds, value) for seconds, value in row["points"]]
    return None


def row(env: str, goal: float, times: dict[str, list[float]], seeds: int) -> Row | None:
    """Medians over the seeds; a seed that did not get there counts as one that never does. None: most of ours did not.

    Where most of the peer's did not, there is no ratio.
    """
    middle = {who: statistics.median(all_) for who, all_ in times.items()}
    if not math.isfinite(middle["ours"]):
        return None
    range_ = {
        who: (min(*all_, LIMIT_SECONDS), max(all_) if math.isfinite(max(all_)) else None) for who, all_ in times.items()
    }
    peer = middle.get(PEER, math.inf)
    its, ratio = (peer, peer / middle["ours"]) if math.isfinite(peer) else (None, None)
    spread = {"ours": range_["ours"]} | ({"peer": range_[PEER]} if PEER in times else {})
    return Row(f"time to {goal:g}, {env}", "s", middle["ours"], PEER, its, ratio, None, "", spread, seeds, command())


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--goals", type=float, nargs="+", default=[2000.0, LARGEST_GOAL])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--every", type=int, default=5000, help="environment steps between evaluations")
    options = parser.parse_args()
    python = peer_python("peers")
    runners: dict[str, Callable[[str, int, int], Iterator[Point]]] = {"ours": ours}
    if python:
        runners[PEER] = partial(sbx, python)
    curves: dict[str, list[list[Point]]] = {who: [] for who in runners}
    for seed, who in product(options.seeds, runners):
        key = {"who": who, "env": options.env, "seed": seed, "every": options.every}
        points = _saved_curve(key, max(options.goals))
        if points is None:
            print(f"{who}, seed {seed}", flush=True)
            points = run(runners[who](options.env, seed, options.every), options.goals)
            with CURVES.open("a") as file:
                line = {**key, "goal": max(options.goals), "time": time.strftime("%Y-%m-%d %H:%M"), "points": points}
                file.write(json.dumps(line) + "\n")
        curves[who].append(points)
    for goal in options.goals:
        times = {who: [reached(points, goal) or math.inf for points in all_] for who, all_ in curves.items()}
        if (measured := row(options.env, goal, times, len(options.seeds))) is None:
            sys.exit(f"time to {goal:g}, {options.env}: most seeds of ours do not get there; older results stand")
        save([measured])


if __name__ == "__main__":
    main()
