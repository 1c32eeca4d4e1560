"""What a window takes on its way and in the ring, and each role's memory in a short run.

    python -m benchmarks.memory [--env HalfCheetah-v5] [--preset robust] [--total-steps 6000]

A role's resident memory is the most that was seen of its process; of the replay server it holds the ring's pages, too.
"""

import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import psutil

from benchmarks import harness
from benchmarks.harness import Row, compare, random_rows
from rmc.common.env.config import EnvConfig
from rmc.common.window import WindowSpec
from rmc.common.wire import encode_windows
from rmc.deploy.run.presets import robust
from rmc.learner.config import MODEL_PROCESS
from rmc.replay_server.ring import Ring

ROWS = 10_000  # of the ring that is measured
CHUNK = 16  # windows an entry
LOOK_SECONDS = 0.2
ROLES = ("launcher", "redis", "replay", "learner", "evaluator", "actor", MODEL_PROCESS)


def sizes(env_id: str) -> list[Row]:
    """Bytes of a window: its numbers, its row, its part of an entry, its part of the ring's file."""
    spec = robust(EnvConfig(env_id)).window_spec()
    payload = sum(spec.dtype[name].itemsize for name in spec.dtype.names or ())
    row, fields = spec.dtype.itemsize, ("its fields", payload)
    return [
        *_exact(f"memory, row of a window, {env_id}", "bytes", row, fields),
        *_exact(f"memory, window in an entry, {env_id}", "bytes", _entry(spec), fields),
        *_exact(f"memory, file of a ring of {ROWS} windows, {env_id}", "bytes", _file(spec), ("its rows", ROWS * row)),
    ]


def _exact(name: str, unit: str, value: float, least: tuple[str, float] | None = None) -> list[Row]:
    """What needs no second measurement."""
    limit = (least[0], lambda: least[1]) if least else None
    return compare(name, unit, lambda: value, {}, limit, rounds=1, less_is_better=True)


def _entry(spec: WindowSpec) -> float:
    return len(encode_windows(random_rows(spec, CHUNK), spec)) / CHUNK


def _file(spec: WindowSpec) -> int:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring"
        Ring(path, spec, ROWS)
        return max(path.stat().st_size, path.stat().st_blocks * 512)


def resident(env_id: str, preset: str, total_steps: int) -> list[Row]:
    """The most that each role of a real run held; of several actors, the largest."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["train", env_id, "--preset", preset, "--total-steps", str(total_steps), "--run-dir", f"{folder}/run"]
        process = subprocess.Popen([sys.executable, "-m", "rmc.cli.main", *words], stdout=subprocess.DEVNULL)
        readings: dict[str, list[float]] = defaultdict(list)
        while process.poll() is None:
            _look(psutil.Process(process.pid), readings)
            time.sleep(LOOK_SECONDS)
        assert process.returncode == 0
    seen = [role for role in ROLES if readings[role]]  # not every run has a process for the model's half
    return [row for role in seen for row in _exact(f"memory, {role}, {env_id}, {preset}", "MB", max(readings[role]))]


def _look(launcher: psutil.Process, readings: dict[str, list[float]]) -> None:
    """Note what each process of the run holds now."""
    for process in [launcher, *launcher.children(recursive=True)]:
        try:
            words, held = process.cmdline(), process.memory_info().rss
        except psutil.Error:  # it has ended meanwhile
            continue
        server = any(f"{name}-server" in word for name in ("redis", "valkey") for word in words)
        words = ["redis"] if server else [word.strip() for word in words]
        role = next((role for role in ROLES if role in words), "launcher")  # or a child of it that has no name yet
        readings["launcher" if process == launcher else role].append(held / 1e6)


def main() -> None:
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--preset", default="robust")
    parser.add_argument("--total-steps", type=int, default=6000)
    options = parser.parse_args()
    harness.save(sizes(options.env) + resident(options.env, options.preset, options.total_steps))


if __name__ == "__main__":
    main()
