"""SAC, TD3 and DDPG of SBX (stable-baselines3 in JAX), with heads like ours, faster on one core.

    python -m studies.sbx --env ENV ... [--only SAC TD3 DDPG] [--seeds 1 2 3] [--steps 300000]

They make an update a step, eight at once after every eighth step. ``make peers`` installs them. A run is a line of
studies/results/sbx-STEPS.jsonl, and is not run again; one that is interrupted begins anew.
"""

import argparse
import json
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

from benchmarks import PEER_ENVIRONMENT
from benchmarks.harness import HERE, peer_python
from rmc.analysis import history
from rmc.analysis.history import Evaluation, History
from studies.study import RESULTS, commit

EVERY, TOGETHER, HEADS = 10_000, 8, ("400", "300")


def run(python: Path, algorithm: str, env: str, seed: int, steps: int) -> History:
    """One run to its end. Raises CalledProcessError where it fails."""
    script = str(HERE / "peers" / "sbx_run.py")
    words = [str(python), script, algorithm, env, str(seed), "--steps", str(steps), "--every", str(EVERY)]
    words += ["--together", str(TOGETHER), "--heads", *HEADS]
    began, evaluations = time.monotonic(), []
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=PEER_ENVIRONMENT) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("{"):
                said, wall = json.loads(line), time.monotonic() - began
                one = Evaluation(said["steps"], said["updates"], wall, said["return"], said["std"])
                print(f"  step {one.env_steps:,}: return {one.return_mean:,.0f}, {wall:,.0f} s", flush=True)
                evaluations.append(one)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, words)
    last = evaluations[-1]
    agent = f"{algorithm} of SBX"
    return History(agent, env, seed, last.env_steps, last.updates, last.wall_s, None, evaluations, True, commit())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", required=True)
    parser.add_argument("--only", nargs="+", choices=["SAC", "TD3", "DDPG"], default=["SAC", "TD3", "DDPG"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--steps", type=int, default=300_000)
    options = parser.parse_args()
    python = peer_python("peers")
    if python is None:
        sys.exit("studies.sbx: SBX is not installed; make peers installs it")
    target = RESULTS / f"sbx-{options.steps}.jsonl"
    for seed, env, algorithm in product(options.seeds, options.env, options.only):
        known = history.read_histories(target) if target.exists() else []
        if (f"{algorithm} of SBX", env, seed) in {(one.agent, one.env, one.seed) for one in known}:
            continue
        print(f"{algorithm} of SBX, {env}, seed {seed}", flush=True)
        line = run(python, algorithm, env, seed, options.steps).to_line()
        with target.open("a") as file:
            file.write(f"{line}\n")


if __name__ == "__main__":
    main()
