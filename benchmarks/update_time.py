"""Where an update's time goes in a run: its learner's processes, sampled by py-spy while they train.

    make bench-update-time
    python -m benchmarks.update_time [--name now] [--python PYTHON] [--env ENV] [--seconds S]

--python trains with another checkout's, under a --name of its own, and draws both: docs/update-time.png. A sample
counts where its thread runs; milliseconds are a process's share of running samples, over the run's updates a second.
"""

import argparse
import json
import linecache
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

from benchmarks.harness import HERE
from rmc.common.errors import ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.learner.config import MODEL_PROCESS

RESULTS, PICTURE = HERE / "results" / "update-time.json", HERE.parent / "docs" / "update-time.png"
RATE = 200  # samples a second
WARM_STEPS = 8_000  # environment steps before the first sample
LEARNER = "critics, policy, temperature"
MODEL = "memory and world model"
OTHER = "losses, autograd, Python"
BY_FUNCTION = {  # the first that a stack has, from its outermost frame on
    "Adam, rounding": {"optimizers.py:step", "optimizer.py:wrapper", "rounded.py:bf16"},
    "gradient's norm": {"clip_grad.py:get_total_norm", "clip_grad.py:_get_total_norm"},
    "targets, averages": {
        "update.py:after_model_step", "update.py:after_actor_critic_step", "policy_average.py:update",
    },
    "batches, priorities": {
        "client.py:sample", "client.py:update_priorities", "batch.py:view_batch", "learner.py:_flush",
    },
    "broadcasts, metrics": {"learner.py:publish", "learner.py:metrics", "learner.py:checkpoint"},
}  # fmt: skip
BY_LINE = {  # what the innermost of our lines calls
    "matrix products": ("torch.mm(", ".addmm_(", "_product(", "baddbmm(", "F.linear(", "super().forward("),
    "gates, biases, ReLUs": ("kernels.",),
}
CATEGORIES = [*BY_LINE, *BY_FUNCTION, OTHER]


def sampled(run: Path, pids: dict[str, int], seconds: float) -> dict[str, dict[str, float]]:
    """Milliseconds of an update by process and category."""
    stacks = {name: run.parent / f"{pid}.txt" for name, pid in pids.items()}
    began = time.time()
    spies = [_spy(pid, stacks[name], seconds) for name, pid in pids.items()]
    if failed := [spy.args for spy in spies if spy.wait()]:
        raise ConfigError("py-spy", failed[0], "it failed; the lines above say why")
    an_update = 1000.0 / updates_per_s(run, lambda one: one["time"] >= began)
    print(f"{1000.0 / an_update:.1f} updates/s")
    return {name: _shares(path, RATE * seconds, an_update) for name, path in stacks.items()}


def updates_per_s(run: Path, counts: Callable[[dict[str, Any]], bool]) -> float:
    """The median of what a run's learner has said, in the records that count."""
    records = [record for record in RunFolder(run).records() if record["role"] == "learner" and counts(record)]
    return statistics.median(one["updates_per_s"] for one in records if "updates_per_s" in one)


def _spy(pid: int, out: Path, seconds: float) -> subprocess.Popen[bytes]:
    words = [str(Path(sys.executable).with_name("py-spy")), "record", "--pid", str(pid), "--rate", str(RATE)]
    words += ["--nonblocking", "--duration", str(round(seconds))]
    words += ["--format", "raw", "--full-filenames", "--output", str(out)]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _shares(path: Path, looks: float, scale: float) -> dict[str, float]:
    counts: Counter[str] = Counter()
    for text in path.read_text().splitlines():
        stack, _, count = text.rpartition(" ")
        counts[category(stack.split(";"))] += int(count)
    return {name: scale * counts[name] / looks for name in CATEGORIES}


def category(stack: list[str]) -> str:
    """Of frames like ``step (/where/optimizers.py:30)``, the outermost first."""
    frames = [
        (name, *where.rstrip(")").rpartition(":")[::2]) for name, _, where in (one.partition(" (") for one in stack)
    ]
    for name, file, _ in frames:
        for kind, functions in BY_FUNCTION.items():
            if f"{Path(file).name}:{name.rpartition('.')[2]}" in functions:
                return kind
    _, file, number = frames[-1]
    text = linecache.getline(file, int(number)) if number.isdigit() else ""
    return next((kind for kind, calls in BY_LINE.items() if any(call in text for call in calls)), OTHER)


@contextmanager
def training(python: str, env: str) -> Iterator[tuple[Path, int]]:
    """A run that is warm and trains on until it is stopped: its folder and its launcher's pid."""
    with tempfile.TemporaryDirectory() as at:
        run = Path(at) / "run"
        words = [python, "-m", "rmc.cli.main", "train", env, "--run-dir", str(run), "--checkpoint-steps", "1000000"]
        launcher = subprocess.Popen(words, cwd=at, stdout=subprocess.DEVNULL)
        try:
            while _env_steps(run) < WARM_STEPS:
                if launcher.poll() is not None:
                    raise ConfigError("train", env, f"it ended with {launcher.returncode}")
                time.sleep(0.5)
            yield run, launcher.pid
        finally:
            launcher.terminate()
            launcher.wait()


def _env_steps(run: Path) -> int:
    folder = RunFolder(run)
    if not folder.metrics.exists():
        return 0
    return max((int(one["env_steps"]) for one in folder.records() if one["role"] == "learner"), default=0)


def _learners(launcher: int) -> dict[str, int]:
    pids = {}
    for process in psutil.Process(launcher).children(recursive=True):
        words = [word.strip() for word in process.cmdline()]
        if MODEL_PROCESS in words:
            pids[MODEL] = process.pid
        elif "learner" in words:
            pids[LEARNER] = process.pid
    return pids if MODEL in pids else {f"{MODEL}; {LEARNER}": pids[LEARNER]}


def draw(results: dict[str, dict[str, dict[str, float]]]) -> None:
    """A bar a process, its parts side by side."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    bars = [(f"{name}: {process}", parts) for name, own in results.items() for process, parts in own.items()]
    figure = Figure(figsize=(9, 1.2 + 0.55 * len(bars)), layout="constrained")
    axes, colours = figure.subplots(), colormaps["tab10"]
    for row, (_, parts) in enumerate(bars):
        left = 0.0
        for number, kind in enumerate(CATEGORIES):
            axes.barh(row, parts[kind], left=left, color=colours(number), label=kind if row == 0 else None)
            left += parts[kind]
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.invert_yaxis()
    axes.set_xlabel("ms an update, while the process runs")
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--name", default="now", help="of the bars in the picture")
    parser.add_argument("--python", default=sys.executable, help="that trains")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--seconds", type=float, default=25.0, help="of samples")
    options = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    with training(options.python, options.env) as (run, launcher):
        results[options.name] = sampled(run, _learners(launcher), options.seconds)
    for process, parts in results[options.name].items():
        print(f"{process}: {sum(parts.values()):.1f} ms, { ({kind: round(ms, 2) for kind, ms in parts.items()}) }")
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    draw(results)


if __name__ == "__main__":
    main()
