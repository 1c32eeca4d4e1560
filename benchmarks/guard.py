"""Whether a change cost return or speed: three short trainings, beside the committed lines of earlier ones.

    make guard
    python -m benchmarks.guard [--only HalfCheetah-v5 Walker2d-v5 cue] [--seed 1] [--record]

Takes about 15 minutes on two quiet cores. --record adds its lines to benchmarks/results/guard.jsonl. The return is the
mean of a run's last three evaluations. Speed is updates a second over GFLOP/s of the update's own products. Those are
timed before and after the run: a slow hour slows both. Lines of another kind of machine say nothing about speed.
"""

import argparse
import json
import shlex
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from benchmarks.harness import HERE
from benchmarks.peers.turns import speed
from benchmarks.update_time import updates_per_s
from rmc.analysis import history
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from studies.study import commit

LINES, RUNS = HERE / "results" / "guard.jsonl", Path("runs") / "guard"
CUE = (
    "--hidden 64 --embedding 64 --heads 128 128 --head-input hidden+observation --normalize-observations "
    "--learning-rate 5e-4 --polyak 0.99 --target-memory ema --batch-size 16 --capacity 5000 --warmup-steps 1000 "
    "--priority-exponent 0 --episodes 10 --replay-ratio 32 --alpha-learning-rate 5e-3"
)
TASKS = {
    "HalfCheetah-v5": "HalfCheetah-v5 --total-steps 60000",
    "Walker2d-v5": "Walker2d-v5 --total-steps 60000",
    "cue": f"tests.memory_env:Memory12-v0 {CUE} --total-steps 10000",
}
EVALUATIONS = 3  # the last ones, of which the return is the mean
WARM = 1_000  # updates before speeds count
RETURN_TOLERANCE = 0.2  # of the least return that a line has: few seeds leave much to chance
SPEED_TOLERANCE = 0.9  # of the lines' median
LIKE_MACHINE = 1.25  # GFLOP/s beyond that ratio are another machine's: an update is not products alone
PRODUCT = 240, 400, 300  # rows, inputs, outputs: a layer of robust's heads
PRODUCT_SECONDS = 3.0


@dataclass(frozen=True)
class Line:
    """A task trained once."""

    task: str
    seed: int
    commit: str
    episode_return: float
    updates_per_s: float
    gflops: float

    @property
    def speed(self) -> float:
        """Updates for every thousand GFLOP that the machine had in that time."""
        return 1000.0 * self.updates_per_s / self.gflops


def trained(task: str, seed: int, code: str) -> Line:
    """Train it. Raises ConfigError where that fails."""
    folder = RUNS / f"{code}-{task}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)  # what changed since may be in no commit
    words = ["train", *shlex.split(TASKS[task]), "--seed", str(seed), "--run-dir", str(folder)]
    before = gflops()
    ended = subprocess.run([sys.executable, "-m", "rmc.cli.main", *words], check=False, stdout=subprocess.DEVNULL)
    if ended.returncode:
        raise ConfigError(task, shlex.join(words), f"it ended with {ended.returncode}; {folder}/logs say why")
    run = RunFolder(folder)
    returns = [one.return_mean for one in history.of_run(run).evaluations]
    speed = updates_per_s(folder, lambda one: one.get("updates", 0) > WARM)
    return Line(task, seed, code, statistics.fmean(returns[-EVALUATIONS:]), speed, (before + gflops()) / 2)


def gflops() -> float:
    """Of a product like those of an update, on one core, in bfloat16."""
    rows, inputs, outputs = PRODUCT
    x, w = torch.randn(rows, inputs).bfloat16(), torch.randn(inputs, outputs).bfloat16()

    def hundred() -> int:
        for _ in range(100):
            torch.mm(x, w)
        return 100

    return 2e-9 * rows * inputs * outputs * speed(hundred, PRODUCT_SECONDS)


def committed() -> list[Line]:
    """The lines of earlier runs."""
    return [Line(**json.loads(line)) for line in LINES.read_text().splitlines()] if LINES.exists() else []


def faults(line: Line, before: Iterable[Line]) -> list[str]:
    """What is worse than the lines of the same task, in words; that there are none is a fault, too."""
    before = [one for one in before if one.task == line.task]
    if not before:
        return ["nothing to compare with; --record makes a first line"]
    least = min(one.episode_return for one in before)
    worse, bound = [], least - RETURN_TOLERANCE * abs(least)
    if not line.episode_return >= bound:  # nor where it is no number
        worse.append(f"return below {bound:,.1f}; the least of {len(before)} lines is {least:,.1f}")
    speeds = [one.speed for one in before if 1 / LIKE_MACHINE <= one.gflops / line.gflops <= LIKE_MACHINE]
    if not speeds:
        worse.append(f"no line is of a machine of about {line.gflops:,.0f} GFLOP/s; --record makes a first one")
    elif not line.speed >= SPEED_TOLERANCE * (usual := statistics.median(speeds)):
        worse.append(f"speed below {SPEED_TOLERANCE:.0%} of {usual:,.1f}, the median of {len(speeds)} lines")
    return worse


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--record", action="store_true", help=f"add the lines to benchmarks/results/{LINES.name}")
    options = parser.parse_args()
    torch.set_num_threads(1)
    before, code, ok = committed(), commit(), True
    print(f"{'task':15} {'seed':>4} {'return':>9} {'updates/s':>10} {'GFLOP/s':>8} {'speed':>7}  verdict", flush=True)
    for task in options.only:
        try:
            line = trained(task, options.seed, code)
        except ConfigError as error:
            sys.exit(f"benchmarks.guard: {error}")
        worse = faults(line, before)
        ok = ok and not worse
        figures = f"{line.episode_return:9,.1f} {line.updates_per_s:10,.1f} {line.gflops:8,.1f} {line.speed:7,.1f}"
        print(f"{task:15} {line.seed:4} {figures}  {'; '.join(worse) or 'ok'}", flush=True)
        if options.record:
            with LINES.open("a") as file:
                file.write(json.dumps(asdict(line)) + "\n")
    sys.exit(0 if ok else 1)


if __name__ == "__main__":
    main()
