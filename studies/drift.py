"""What h holds of the observation, and how far it moves: a run's checkpoints on windows of its own ring.

    python -m studies.drift RUN [RUN ...] [--windows 400]

Printed is R², held out: of o_t by a linear map from h_t; of h by an earlier checkpoint's h; of what the newest critics
and policy make of an earlier h, beside today's. 1 is "all of it". Distance is that of the same state under two
checkpoints over that of two random states.
"""

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rmc.analysis.world_model_picture import load_agent
from rmc.common.agent import Agent
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.critic import critic_input
from rmc.common.window import Rows
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.learner.batch import Batch, clear_padding, view_batch
from rmc.learner.unroll import impute_and_unroll
from rmc.replay_server.ring import Ring

RIDGE = 1e-5  # of the probe, times its number of steps


class Seen(NamedTuple):
    """A checkpoint's networks, and what they make of the windows; N trained steps in all."""

    agent: Agent
    hidden: Tensor  # (N, H)
    read: Tensor  # (N, Z), what the heads read
    observation: Tensor  # (N, O), normalised, what was missing filled


def held_out_r2(x: Tensor, y: Tensor) -> Tensor:
    """(O,) of y (N, O) by a ridge regression on x (N, H), fitted to the first half and judged by the other."""
    n = len(x) // 2
    x, y = x.double(), y.double()
    mean_x, mean_y = x[:n].mean(0), y[:n].mean(0)
    a = x[:n] - mean_x
    weights = torch.linalg.solve(a.T @ a + RIDGE * n * torch.eye(a.shape[1], dtype=a.dtype), a.T @ (y[:n] - mean_y))
    return r2(y[n:], (x[n:] - mean_x) @ weights + mean_y)


def r2(y: Tensor, predicted: Tensor) -> Tensor:
    """(O,) share of the variance of y (N, O) that is explained."""
    variance = (y - y.mean(0)).square().sum(0)
    return 1.0 - (y - predicted).square().sum(0) / variance.clamp(min=1e-12)


def windows_of(folder: Path, config: RunConfig, count: int) -> Rows:
    """Whole windows out of a copy of the run's ring, in random order."""
    spec = config.window_spec()
    with tempfile.TemporaryDirectory() as at:
        shutil.copy(folder / "replay" / "ring", at)
        ring = Ring(Path(at) / "ring", spec, config.replay.capacity)
        numbers = np.random.default_rng(0).permutation(ring.progress.windows)[:count]
        rows: Rows = ring.rows[numbers].copy()
    rows = rows[(rows["last"] == spec.steps) & (rows["first"] == 0)]
    clear_padding(rows, spec)
    return rows


@torch.no_grad()
def seen_by(folder: RunFolder, number: int, config: RunConfig, batch: Batch) -> Seen:
    """A checkpoint's."""
    agent = load_agent(folder, config, str(number))
    o, remembered = impute_and_unroll(agent, agent.normalizer(batch.observation, batch.missing), batch)
    parts = remembered.hidden, agent.features(remembered), o[:, config.window_spec().burn_in :]
    return Seen(agent, *(part[:, :-1].flatten(0, 1) for part in parts))


@torch.no_grad()
def report(run: Path, count: int) -> None:
    """Print a run's lines."""
    folder = RunFolder(run)
    config = folder.config()
    rows = windows_of(run, config, count)
    raw = torch.from_numpy(rows.view("u1").reshape(len(rows), -1))
    batch = view_batch(raw, torch.ones(len(rows)), config.window_spec())
    *before, number = CheckpointFolder(folder.checkpoints).numbers()
    now = seen_by(folder, number, config, batch)
    probe = sorted(held_out_r2(now.hidden, now.observation).tolist())
    print(f"{run.name}, {len(rows)} windows, update {number:,}")
    print(f"  o: median {probe[len(probe) // 2]:.2f}, worst dimensions " + ", ".join(f"{x:.2f}" for x in probe[:5]))
    for earlier in before:
        then = seen_by(folder, earlier, config, batch)
        print(f"  {number - earlier:,} updates before: {_compared(now, then, batch)}")


def _compared(now: Seen, then: Seen, batch: Batch) -> str:
    """The newest heads on both."""
    agent, steps = now.agent, slice(-len(now.hidden) // len(batch.action), None)
    action = batch.action[:, steps].flatten(0, 1)
    privileged = agent.normalized_privileged(batch.privileged[:, :-1][:, steps]).flatten(0, 1)
    reads = [critic_input(seen.read[None], privileged[None]) for seen in (now, then)]
    q, q_then = (agent.critic(read, action[None]).mean(0).T for read in reads)
    mean, mean_then = (torch.tanh(agent.policy(seen.read)[0]) for seen in (now, then))
    distance = (now.hidden - then.hidden).norm(dim=1).mean() / (2.0**0.5 * now.hidden.std(0).norm())
    shares = {"h": held_out_r2(then.hidden, now.hidden), "Q": r2(q, q_then), "action": r2(mean, mean_then)}
    return f"distance {distance:.2f}, " + ", ".join(f"{name} {share.mean():.2f}" for name, share in shares.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs")
    parser.add_argument("--windows", type=int, default=400)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for run in options.runs:
        report(run, options.windows)


if __name__ == "__main__":
    main()
