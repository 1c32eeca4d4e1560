"""Trained transitions a second of the whole learner role, beside its bare update and stable-baselines3's SAC.

    python -m benchmarks.learner [--env ENV] [--batches 16 32 64 256] [--longest 50 100 200] [--rounds N] [--seconds S]

A transition is trained when it is in a batch as a trained step: 15 for each window, B for each of SAC's batches. The
learner has one thread on the first core and draws from a real replay server, which has the last one with Redis; SAC has
its transitions in memory, one thread on the first core in one row, two on the first and the last in the other.
Then updates a second of batches of windows of 1 000 steps, of which the longest has so many real ones: cut to that
beside whole. ``benchmarks.growth window`` has the role's updates of full windows by their length.
"""

import dataclasses
import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import cycle
from pathlib import Path

import numpy as np
import torch

from benchmarks.harness import (
    ENDLESS,
    SECRET,
    Measure,
    Row,
    argument_parser,
    compare,
    on_cores,
    random_rows,
    replay_process,
    save,
    started_peer,
)
from benchmarks.peers.turns import speed
from benchmarks.sender import Sender
from rmc.common.agent import Agent
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.window import WindowSpec
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.presets import robust
from rmc.learner.batch import clear_padding, view_batch
from rmc.learner.config import Precision
from rmc.learner.learner import Learner
from rmc.learner.precision import has_fast_bf16
from rmc.learner.replay.client import ReplayClient
from rmc.learner.update_order import make_update
from rmc.replay_server.config import ReplayConfig

PRECISIONS: tuple[Precision, ...] = ("bf16", "fp32")
WINDOWS = 4800  # in the ring
SAC_BATCH = 256
LONG_WINDOW = 1_000  # steps


@contextmanager
def replay_of(run: RunConfig) -> Iterator[RedisBus]:
    """A replay server with windows to draw, as fast as it is asked."""
    with replay_process(run.window_spec(), ReplayConfig(replay_ratio=1e9, warmup_steps=0)) as bus:
        sender = Sender(bus, run.window_spec())
        for _ in range(WINDOWS // sender.chunk):
            sender.send()
        sender.wait()
        yield bus


@contextmanager
def learner_role(run: RunConfig, bus: RedisBus, batch_size: int, precision: Precision) -> Iterator[Learner]:
    spec = run.window_spec()
    config = dataclasses.replace(run.learner, batch_size=batch_size, checkpoint_steps=ENDLESS, precision=precision)
    client = ReplayClient(lambda: bus.replay_address("replay"), SECRET, spec, batch_size)
    with tempfile.TemporaryDirectory() as at:
        role = Learner(spec, run.agent, run.update, config, client, bus, CheckpointFolder(Path(at)), 0)
        yield role
        role.finished = True  # nothing to save
        role.close()
    client.close()


def _bare(run: RunConfig, batch_size: int, precision: Precision, seconds: float) -> Measure:
    """Forward and backward on one batch in place, the policy's as often as in a run."""
    spec = run.window_spec()
    agent = Agent(spec.obs_dim, spec.action_dim, run.agent)
    update, beta = make_update(agent, run.update, 0, precision == "bf16"), torch.zeros(())
    rows = random_rows(spec, batch_size)
    raw = torch.from_numpy(rows.view("u1").reshape(batch_size, -1))
    plans = [update.plan(raw, spec, number) for number in range(2, 2 + run.update.policy_delay)]  # in one the policy's
    batches = cycle([view_batch(raw, torch.ones(batch_size), spec, plan) for plan in plans])

    def work() -> int:
        parts, *_ = update.forward(next(batches), beta)
        agent.zero_grad(set_to_none=True)
        sum(parts.values()).backward()  # type: ignore[union-attr]
        return batch_size * spec.train

    return lambda: speed(work, seconds)


def measure(
    run: RunConfig,
    bus: RedisBus,
    batch_size: int,
    precision: Precision,
    sac: dict[str, Measure | None],
    seconds: float,
    rounds: int,
) -> list[Row]:
    """One batch size in one precision."""
    with learner_role(run, bus, batch_size, precision) as role:

        def work() -> int:
            return batch_size * run.window.trained_steps if role.step() else 0

        speed(work, 1.0)
        name = f"learner, {run.env.id}, batch {batch_size}, {precision}"
        ceiling = "bare forward and backward", _bare(run, batch_size, precision, seconds)
        return compare(name, "transitions/s", lambda: speed(work, seconds), sac, ceiling, rounds)


def cut(run: RunConfig, longest: int, seconds: float, rounds: int) -> list[Row]:
    """Updates of one batch in place, cut where its longest window ends beside whole."""
    window = dataclasses.replace(run.window, trained_steps=LONG_WINDOW - run.window.burn_in)
    run = dataclasses.replace(run, window=window)
    spec, count = run.window_spec(), run.learner.batch_size
    rows = random_rows(spec, count)
    rows["last"] = spec.burn_in + np.random.default_rng(0).integers(1, longest + 1, count)
    rows["last"][0] = spec.burn_in + longest
    clear_padding(rows, spec)
    raw, beta = torch.from_numpy(rows.view("u1").reshape(count, -1)), torch.zeros(())

    def measured(is_cut: bool) -> Measure:
        agent = Agent(spec.obs_dim, spec.action_dim, run.agent)
        update = make_update(agent, run.update, 0, has_fast_bf16(torch.device("cpu")))

        plan = update.plan(raw, spec, 2)
        if not is_cut:
            plan = plan._replace(steps=spec.steps)

        def work() -> int:
            update(view_batch(raw, torch.ones(count), spec, plan), beta)
            return 1

        speed(work, 1.0)
        return lambda: speed(work, seconds)

    name = f"learner, {run.env.id}, windows of {LONG_WINDOW} steps, {longest} real at most"
    whole: dict[str, Measure | None] = {"whole windows": measured(False)}
    return compare(name, "updates/s", measured(True), whole, rounds=rounds)


def _sac(stack: ExitStack, spec: WindowSpec, threads: int, seconds: float) -> Measure | None:
    """SAC in an environment of its own, on as many cores as it has threads."""
    cores, words = sorted(os.sched_getaffinity(0)), (spec.obs_dim, spec.action_dim, SAC_BATCH, threads)
    with on_cores({cores[0]} if threads == 1 else {cores[0], cores[-1]}):
        return started_peer(stack, "peers", "sb3_learner", seconds, *words)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--batches", type=int, nargs="*", default=[16, 32, 64, 256])
    parser.add_argument("--longest", type=int, nargs="*", default=[50, 100, 200])
    options = parser.parse_args()
    run = robust(EnvConfig(options.env))
    torch.set_num_threads(1)
    rows: list[Row] = []
    with ExitStack() as stack:
        spec = run.window_spec()
        sac = {
            f"stable-baselines3 SAC, {threads} threads": _sac(stack, spec, threads, options.seconds)
            for threads in (1, 2)
        }
        bus = stack.enter_context(replay_of(run))
        for batch_size in options.batches:
            for precision in PRECISIONS:
                rows += measure(run, bus, batch_size, precision, sac, options.seconds, options.rounds)
    for longest in options.longest:
        rows += cut(run, longest, options.seconds, options.rounds)
    save(rows)


if __name__ == "__main__":
    main()
