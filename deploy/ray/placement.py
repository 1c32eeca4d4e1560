"""Where a run's roles go on a Ray cluster, and what each of them takes."""

import time
from dataclasses import dataclass
from math import ceil
from typing import Any

import ray
from ray._private.state import available_resources_per_node

from rmc.common.errors import ConfigError
from rmc.deploy.local.role_command import (
    RoleCommand,
    actor_commands,
    evaluator_commands,
    learner_command,
    replay_command,
)
from rmc.deploy.ray.learner_actor import LearnerActor
from rmc.deploy.ray.role_actor import RoleActor
from rmc.deploy.ray.role_handle import RoleHandle
from rmc.deploy.run.config import RunConfig

REPLAY_CPUS = EVALUATOR_CPUS = 0.5  # beside the learner
SHARD_CPUS = 1.0  # of a replay server among several, wherever it is: whole ones, so that what is left is whole, too
LEARNER = "learner"  # the group of the learner and of who is beside it
FREE_SECONDS = 10.0  # for what ran before to give back its CPUs


def cpus() -> float:
    """CPUs of all nodes that are alive."""
    return float(sum(node["Resources"].get("CPU", 0.0) for node in ray.nodes() if node["Alive"]))


def learner_cpus(config: RunConfig) -> int:
    """CPUs set aside for the learner: its threads, one by default."""
    return max(1, config.learner.threads)


def reserved_cpus(config: RunConfig) -> int:
    """CPUs of everything but the actors."""
    return int(sum(need["CPU"] for need in groups(config, "cpu").values()))


def groups(config: RunConfig, device: str) -> dict[str, dict[str, float]]:
    """What a node must hold for the learner and who is beside it, and for each of several replay servers."""
    learner = {"CPU": learner_cpus(config) + EVALUATOR_CPUS + REPLAY_CPUS}
    if device.startswith("cuda"):
        learner["GPU"] = 1.0
    shards = config.shards() if config.replay.replay_shards > 1 else ()
    return {LEARNER: learner} | {shard.role: {"CPU": SHARD_CPUS} for shard in shards}


def check_room(config: RunConfig, device: str) -> None:
    """Raises ConfigError where no node can hold the learner."""
    need = groups(config, device)[LEARNER]
    if not any(node["Alive"] and holds(node, need) for node in ray.nodes()):
        resources = ", ".join(f"{amount:g} {name}" for name, amount in need.items())
        fault = f"no node of the cluster has {resources}, which the learner and what is beside it take"
        if "GPU" in need and not any(node["Alive"] and node["Resources"].get("GPU") for node in ray.nodes()):
            raise ConfigError("--device", device, f"{fault}; take cpu, or start one that has")
        raise ConfigError("--threads", config.learner.threads, f"{fault}; take fewer, or start one that has")


def actors_that_fit(config: RunConfig) -> int:
    """One for every CPU that is left. Raises ConfigError where there is none."""
    need = reserved_cpus(config) + config.replay.replay_shards
    deadline = time.monotonic() + FREE_SECONDS
    while free_cpus() < need:
        if time.monotonic() > deadline:
            free = f"{free_cpus()} of the cluster's {cpus():g} CPUs are free"
            raise ConfigError(
                "--launcher", "ray", f"{free} and a run needs {need:g}; start more nodes, or end other runs"
            )
        time.sleep(0.2)
    return whole_shares(free_cpus() - reserved_cpus(config), config)


def free_cpus() -> int:
    """CPUs that nothing on the cluster has taken."""
    return int(ray.available_resources().get("CPU", 0.0))


def free_resources() -> list[tuple[dict[str, Any], dict[str, float]]]:
    """Every node that is alive, with what nothing has taken of it."""
    free = available_resources_per_node()
    return [(node, free.get(node["NodeID"], {})) for node in ray.nodes() if node["Alive"]]


def nodes_by_room() -> list[str]:
    """Ray's ids of the nodes that are alive, those with the most free CPUs first."""
    roomy = sorted(free_resources(), key=lambda one: one[1].get("CPU", 0.0), reverse=True)
    return [node["NodeID"] for node, _ in roomy]


def actors_in_the_way(
    need: dict[str, float], node: dict[str, Any], free: dict[str, float], actors: list[RoleHandle]
) -> list[RoleHandle] | None:
    """The last of a node's ``actors``, as many as end for ``need`` to fit there; None where all are too few."""
    there = [one for one in actors if one.running and one.node == node["NodeManagerAddress"]]
    short = max(0, ceil(need["CPU"] - free.get("CPU", 0.0)))
    fits = all(free.get(name, 0.0) >= amount for name, amount in need.items() if name != "CPU")
    return there[len(there) - short :] if fits and short <= len(there) else None


def whole_shares(actors: int, config: RunConfig) -> int:
    """As many of them as give every replay server the same share."""
    return actors - actors % config.replay.replay_shards


def holds(node: dict[str, Any], need: dict[str, float]) -> bool:
    """Whether a node is as large as that, were nothing else on it."""
    return all(node["Resources"].get(name, 0.0) >= amount for name, amount in need.items())


@dataclass(frozen=True)
class RolePlacement:
    """How Ray is asked for a role's host."""

    kind: type[RoleActor]
    command: RoleCommand
    cpus: float
    gpus: float = 0.0
    group: str = ""  # of ``groups``; an actor has none


def places(config: RunConfig, run: str, device: str, encrypted: bool) -> dict[str, RolePlacement]:
    """All roles of a run but its launcher, by name."""
    secrets = ["--secret-file", "{scratch}/secret"]
    if encrypted and config.replay.replay_shards > 1:  # one alone has a unix socket
        secrets += ["--tls-folder", "{scratch}"]
    learner, gpus = learner_command(run, "{scratch}/checkpoints", device, secrets), float(device.startswith("cuda"))
    placements = [
        *_replays(config, run, secrets),
        RolePlacement(LearnerActor, learner, learner_cpus(config), gpus, LEARNER),
        *(
            RolePlacement(RoleActor, command, EVALUATOR_CPUS, group=LEARNER)
            for command in evaluator_commands(config, run)
        ),
        *(RolePlacement(RoleActor, command, 1.0) for command in actor_commands(config, run)),
    ]
    return {place.command.name: place for place in placements}


def _replays(config: RunConfig, run: str, secrets: list[str]) -> list[RolePlacement]:
    """One beside the learner on a unix socket, or several anywhere on the cluster's network."""
    alone = config.replay.replay_shards == 1
    listen = "unix:{scratch}/replay.sock" if alone else "tcp:{ip}:0"
    cpus = REPLAY_CPUS if alone else SHARD_CPUS
    return [
        RolePlacement(
            RoleActor,
            replay_command(shard, run, f"{{scratch}}/{shard.role}", listen, secrets),
            cpus,
            group=LEARNER if alone else shard.role,
        )
        for shard in config.shards()
    ]
