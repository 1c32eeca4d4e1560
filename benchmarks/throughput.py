"""Learner, actor and ingest with everything on, each beside its ceiling.

    python -m benchmarks.throughput [learner] [actor] [ingest] [--pairs N] [--seconds S]

The measured process has the first core, Redis and the replay server the last one.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from actors.actor import Actor, ActorConfig
from benchmarks.harness import ENDLESS, SECRET, Row, alternate, random_rows, record, replay_process, speed
from common.agent import AgentConfig
from common.bus import EntryId
from common.checkpoint import CheckpointFolder
from common.envs import EnvConfig, env_spaces, make_env
from common.redis_bus import RedisBus
from common.window import WindowSpec
from common.wire import encode_hello, encode_windows
from deploy.presets import robust
from learner.batch import view_batch
from learner.learner import Learner, LearnerConfig
from learner.replay_client import ReplayClient
from replay_server.server import ReplayConfig

CHUNK = 16  # windows an entry


def _spec(env_id: str, agent: AgentConfig) -> WindowSpec:
    obs_dim, action_dim, _ = env_spaces(EnvConfig(env_id))
    return WindowSpec(obs_dim, action_dim, agent.hidden)


def _push(bus: RedisBus, spec: WindowSpec, entries: int, first: int) -> None:
    rows = random_rows(spec, CHUNK)
    for seq in range(first, first + entries):
        bus.append(0, EntryId(1, seq), encode_windows(rows, spec))


def _wait_for_commit(bus: RedisBus, seq: int) -> None:
    while (ack := bus.ack(0)) is None or ack.id < EntryId(1, seq):
        time.sleep(0.0005)


def learner(env_id: str, batch_size: int, pairs: int, seconds: float) -> Row:
    """Updates a second of the whole role, against forward and backward alone on one batch in place."""
    run = robust(EnvConfig(env_id))
    spec = _spec(env_id, run.agent)
    config = LearnerConfig(batch_size=batch_size, checkpoint_steps=ENDLESS)
    torch.set_num_threads(1)
    with (
        replay_process(spec, ReplayConfig(replay_ratio=1e9, warmup_steps=0)) as bus,
        tempfile.TemporaryDirectory() as at,
    ):
        bus.append(0, EntryId(1, 0), encode_hello(spec))
        _push(bus, spec, 300, 1)
        _wait_for_commit(bus, 300)
        address = bus.replay_address("replay")
        assert address is not None
        client = ReplayClient(lambda: address.address, SECRET, spec, batch_size)
        role = Learner(spec, run.agent, run.update, config, client, bus, CheckpointFolder(Path(at)), 0)
        rows = random_rows(spec, batch_size)
        batch = view_batch(torch.from_numpy(rows.view("u1").reshape(batch_size, -1)), torch.ones(batch_size), spec)

        def bare() -> int:
            parts, _ = role.update.forward(batch, role.beta)
            role.agent.zero_grad(set_to_none=True)
            sum(parts.values()).backward()  # type: ignore[union-attr]
            return 1

        work: Callable[[], int] = lambda: int(role.step())  # noqa: E731
        speed(work, 1.0)
        result = alternate(
            f"learner, batch {batch_size}, {env_id}",
            "updates/s",
            lambda: speed(work, seconds),
            lambda: speed(bare, seconds),
            "bare forward and backward",
            pairs,
        )
        role.finished = True  # nothing to save
        role.close()
        client.close()
    return result


def actor(env_id: str, envs: int, pairs: int, seconds: float) -> Row:
    """Environment steps a second of one actor on one core, against stepping the same environments alone."""
    agent = robust(EnvConfig(env_id)).agent
    spec, env = _spec(env_id, agent), EnvConfig(env_id)
    torch.set_num_threads(1)
    with replay_process(spec, ReplayConfig(warmup_steps=ENDLESS)) as bus, tempfile.TemporaryDirectory() as at:
        client = ReplayClient(lambda: None, SECRET, spec, 1)
        run = robust(env)
        role = Learner(spec, agent, run.update, LearnerConfig(), client, bus, CheckpointFolder(Path(at)), 0)
        role.updates = 1  # past the random phase
        role.publish()
        config = ActorConfig(envs_per_actor=envs)
        stepper = Actor(0, 0, lambda: make_env(env), spec, agent, config, bus)
        plain = [make_env(env) for _ in range(envs)]
        for index, one in enumerate(plain):
            one.reset(seed=index)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, envs, spec.action_dim)).astype(np.float32)
        turn = 0

        def ours() -> int:
            return envs * int(stepper.step())

        def raw() -> int:
            nonlocal turn
            turn += 1
            for one, action in zip(plain, actions[turn % 64], strict=True):
                *_, terminated, truncated, _ = one.step(action)
                if terminated or truncated:
                    one.reset()
            return envs

        speed(ours, 1.0)
        result = alternate(
            f"actor, {envs} environments, {env_id}",
            "steps/s",
            lambda: speed(ours, seconds),
            lambda: speed(raw, seconds),
            "raw stepping",
            pairs,
        )
        stepper.close()
        role.finished = True
        role.close()
    return result


def ingest(env_id: str, pairs: int, seconds: float) -> Row:
    """Windows a second from an actor's rows to the committed ring, against copying the same rows once."""
    spec = _spec(env_id, AgentConfig())
    rows, target = random_rows(spec, 4096), np.zeros(4096, spec.dtype)
    entries = max(1, int(seconds * 500))
    with replay_process(spec, ReplayConfig(warmup_steps=ENDLESS)) as bus:
        bus.append(0, EntryId(1, 0), encode_hello(spec))
        sent = 0

        def ours() -> float:
            nonlocal sent
            start = time.perf_counter()
            _push(bus, spec, entries, sent + 1)
            sent += entries
            _wait_for_commit(bus, sent)
            return entries * CHUNK / (time.perf_counter() - start)

        def copy() -> float:
            def once() -> int:
                np.copyto(target, rows)
                return len(rows)

            return speed(once, seconds / 4)

        ours()
        return alternate(f"ingest, {CHUNK} windows an entry, {env_id}", "windows/s", ours, copy, "one copy", pairs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", nargs="*", default=["learner", "actor", "ingest"])
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0)
    options = parser.parse_args()
    rows: list[Row] = []
    if "learner" in options.what:
        rows += [learner(options.env, size, options.pairs, options.seconds) for size in (64, 256)]
    if "actor" in options.what:
        rows += [actor(options.env, envs, options.pairs, options.seconds) for envs in (4, 8, 16, 32, 64, 128)]
    if "ingest" in options.what:
        rows.append(ingest(options.env, options.pairs, options.seconds))
    path = Path("benchmarks/results") / f"throughput-{time.strftime('%Y-%m-%d')}.jsonl"
    record(rows, path, " ".join(["python -m benchmarks.throughput", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
