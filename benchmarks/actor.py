"""Environment steps a second of one actor on one core, beside bare stepping and stable-baselines3's collection.

    python -m benchmarks.actor [--env HalfCheetah-v5] [--envs 8 32 64 128] [--rounds N] [--seconds S]

The actor has everything on: windows are built and sent through a real Redis to a real replay server, which share the
last core. The limit steps the same environments, as gymnasium makes them, with random actions on the actor's core. The
peer, SAC's ``predict`` and ``env.step`` with as large a policy, has all cores and takes the thread count that suits it.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import gymnasium as gym
import numpy as np
import torch
from safetensors.torch import save

from benchmarks import harness
from benchmarks.harness import ENDLESS, Measure, Row, compare, replay_process, started_peer
from benchmarks.peers.turns import speed
from rmc.actors.actor import Actor
from rmc.actors.config import ActorConfig
from rmc.common.agent import Agent
from rmc.common.bus.protocol import Version
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.window import WindowSpec
from rmc.deploy.run.presets import robust
from rmc.replay_server.config import ReplayConfig

DEFAULT_ENVS = 8  # of an actor; what peers are compared with
WARM_SECONDS = 1.0


@contextmanager
def collecting(env: EnvConfig, envs: int) -> Iterator[Actor]:
    """A real actor past its random phase, whose credit never ends."""
    run = robust(env)
    spec = run.window_spec()
    with replay_process(spec, ReplayConfig(warmup_steps=ENDLESS)) as bus:
        bus.publish_weights(Version(1, 1), save(Agent(spec.obs_dim, spec.action_dim, run.agent).policy_weights()))
        actor = Actor(0, 0, lambda: make_env(env), spec, run.agent, ActorConfig(envs_per_actor=envs), bus)
        yield actor
        actor.close()


class Bare:
    """The same environments without any of ours about them: no policy, no windows, random actions."""

    def __init__(self, env_id: str, envs: int, spec: WindowSpec) -> None:
        gym_spec = gym.spec(env_id)
        gym_spec.order_enforce = False
        self._envs = [gym.make(gym_spec, disable_env_checker=True) for _ in range(envs)]
        for index, one in enumerate(self._envs):
            one.reset(seed=index)
        self._actions = np.random.default_rng(0).uniform(-1.0, 1.0, (64, envs, spec.action_dim)).astype(np.float32)
        self._actions *= self._envs[0].action_space.high  # type: ignore[attr-defined]
        self._turn = 0

    def step(self) -> int:
        """One step of each; how many there are."""
        self._turn += 1
        for one, action in zip(self._envs, self._actions[self._turn % 64], strict=True):
            *_, terminated, truncated, _ = one.step(action)
            if terminated or truncated:
                one.reset()
        return len(self._envs)


def measure(env_id: str, envs: int, peers: dict[str, Measure | None], rounds: int, seconds: float) -> list[Row]:
    """One number of environments."""
    env = EnvConfig(env_id)
    with collecting(env, envs) as actor:
        bare = Bare(env_id, envs, robust(env).window_spec())
        work = partial(_stepped, actor, envs)
        speed(work, WARM_SECONDS)
        return compare(
            f"actor, {envs} environments, {env_id}", "steps/s",
            lambda: speed(work, seconds), peers, ("bare stepping", lambda: speed(bare.step, seconds)), rounds,
        )  # fmt: skip


def _stepped(actor: Actor, envs: int) -> int:
    return envs * int(actor.step())


def main() -> None:
    parser = harness.argument_parser(__doc__)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--envs", type=int, nargs="+", default=[8, 32, 64, 128], help="environments of the actor")
    options = parser.parse_args()
    torch.set_num_threads(1)
    for envs in options.envs:
        with ExitStack() as stack:
            peers = {
                f"stable-baselines3 SAC, {peer_envs} at a time": started_peer(
                    stack, "peers", "sb3_actor", options.seconds, options.env, peer_envs
                )
                for peer_envs in ((DEFAULT_ENVS, 1) if envs == DEFAULT_ENVS else ())
            }
            harness.save(measure(options.env, envs, peers, options.rounds, options.seconds))


if __name__ == "__main__":
    main()
