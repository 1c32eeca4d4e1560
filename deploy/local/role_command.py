"""The command line of each role: ``rmc role`` and its words, the same on this machine, on Ray and by hand."""

from collections.abc import Sequence
from dataclasses import dataclass

from rmc.common.bus.protocol import actor_role
from rmc.common.shard import Shard
from rmc.deploy.run.config import RunConfig


@dataclass(frozen=True)
class RoleCommand:
    """How a role is started: ``rmc`` and its words. A run's name, which may begin with a dash, is in one with --run."""

    name: str
    words: tuple[str, ...]
    single_thread: bool = True
    forked: bool = True  # if of a single thread: by the fork server, which has torch in memory
    ends: bool = False  # cleanly, once the run is done; any other that ends unasked is started again
    env_timeout: float = 0.0  # seconds, of one that plays: what it hung for does not count as lived


def actor_commands(config: RunConfig, run: str) -> list[RoleCommand]:
    """One for every actor of the ``run``."""
    return [
        _playing(config, actor_role(index), "actor", f"--run={run}", "--index", str(index))
        for index in range(config.actors)
    ]


def evaluator_commands(config: RunConfig, run: str) -> list[RoleCommand]:
    """One, or none where the run is not evaluated while it trains."""
    return [_playing(config, "evaluator", "evaluator", f"--run={run}")] if config.evaluator.episodes else []


def _playing(config: RunConfig, name: str, *words: str) -> RoleCommand:
    return RoleCommand(name, ("role", *words), env_timeout=config.env.env_timeout)


def learner_command(run: str, checkpoints: str, device: str, secrets: Sequence[str]) -> RoleCommand:
    """The learner's; ``secrets`` are the options that say where the run's secret files are."""
    words = (f"--run={run}", *secrets, "--folder", checkpoints, "--device", device)
    return RoleCommand("learner", ("role", "learner", *words), single_thread=False, ends=True)


def replay_command(shard: Shard, run: str, folder: str, listen: str, secrets: Sequence[str]) -> RoleCommand:
    """A replay server's, which has no torch and so is not forked from what has."""
    words = (f"--run={run}", *secrets, "--folder", folder, "--listen", listen, "--shard", str(shard.index))
    return RoleCommand(shard.role, ("role", "replay", *words), forked=False)


def launcher_command(folder: str, ray_address: str) -> RoleCommand:
    """That of a run's launcher on a Ray cluster's head; its other options are those of the run's newest start."""
    words = ("role", "launcher", folder, "--ray-address", ray_address)
    return RoleCommand("launcher", words, single_thread=False, ends=True)
