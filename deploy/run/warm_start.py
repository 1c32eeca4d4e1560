"""What a new run begins with, where that is another run's networks: its checkpoint 0, which every launcher carries.

The learner takes a checkpoint up as ever; so does the one that is started again after a crash. Optimisers begin anew.
"""

import json
from dataclasses import dataclass, fields
from typing import Any

import safetensors.torch
import torch
from torch import Tensor

from rmc.common.agent import Agent, initial_agent
from rmc.common.agent_config import POLICY_PARTS
from rmc.common.checkpoint import PROGRESS
from rmc.common.errors import ConfigError, first_line
from rmc.common.replay import ObservationStatistics
from rmc.common.user_path import user_path
from rmc.common.window import WindowSpec
from rmc.deploy.run.checkpoint_choice import choose_checkpoint
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.env_sizes import FLAGS
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import InitParts
from rmc.deploy.run.option_names import option
from rmc.learner.learner_checkpoint import NOT_OURS, LearnerProgress, pack, read_state
from rmc.learner.update import JointUpdate
from rmc.learner.update_order import make_update

OPTION = "--init-from"
PREDICTS = ("normalizer.", "memory.", "world_model.", "next_frame.")
PARTS: dict[InitParts, tuple[str, ...]] = {  # the beginnings of what is taken
    "all": ("",),
    "memory+world-model": PREDICTS,
    "policy": POLICY_PARTS,
}
NOT_IN: dict[InitParts, set[str]] = {  # options of the networks that say nothing of these parts
    "all": {"initial_priority", "gate_init"},
    "memory+world-model": {"initial_priority", "gate_init", "critic_batch_norm", "privileged_critic"},
    "policy": {"initial_priority", "gate_init", "critic_batch_norm", "privileged_critic", "grounding"},
}


@dataclass(frozen=True)
class InitialCheckpoint:
    """A checkpoint's files, and where they are from, for the run's history."""

    files: dict[str, bytes]
    origin: dict[str, Any]


def prepare(config: RunConfig, init_from: str, parts: InitParts) -> InitialCheckpoint:
    """Checkpoint 0 of a run that begins with ``RUN`` or ``RUN:CHECKPOINT``.

    Raises ConfigError where there is no such checkpoint, or its networks have other sizes.
    """
    folder, which = _split(init_from)
    try:
        source = folder.config()
        number, files = choose_checkpoint(folder, which)
    except ConfigError as error:
        raise ConfigError(OPTION, init_from, error.fix) from None
    try:
        state = read_state(files, torch.device("cpu"))
        _check_sizes(init_from, parts, source, config, state["agent"])
        update = _begun(config, state, parts, bool(source.update.policy_ema_updates))
        progress = _progress(config.window_spec(), update.agent, json.loads(files[PROGRESS]), parts)
    except NOT_OURS as error:
        fix = f"its checkpoint {number} cannot be used ({first_line(error)}); use another"
        raise ConfigError(OPTION, init_from, fix) from None
    weights = {name: value.contiguous() for name, value in update.average.policy_weights().items()}
    policy = safetensors.torch.save(weights, config.policy_header().metadata())
    checkpoint = pack(update.state_dict(), policy, progress)
    return InitialCheckpoint(
        checkpoint, {"asked": [init_from, parts], "run": str(folder.path), "checkpoint": number, "parts": parts}
    )


def _split(init_from: str) -> tuple[RunFolder, str]:
    if user_path(init_from).exists():
        return RunFolder(user_path(init_from)), "latest"
    run, colon, which = init_from.rpartition(":")
    if not (colon and user_path(run).exists()):
        raise ConfigError(OPTION, init_from, "no such run; give the folder of a run, or RUN:CHECKPOINT")
    return RunFolder(user_path(run)), which


def _check_sizes(
    init_from: str, parts: InitParts, source: RunConfig, config: RunConfig, agent: dict[str, Tensor]
) -> None:
    sizes = {"observations": len(agent["normalizer.mean"]), "actions": len(agent["policy.net.4.bias"]) // 2}
    if source.agent.missing_flag:
        width = agent["memory.embed.0.weight" if source.agent.embedding else "memory.gru.weight_ih_l0"].shape[1]
        sizes[FLAGS] = width - sizes["observations"] - sizes["actions"]
    if parts == "all" and "privileged_normalizer.mean" in agent:
        sizes["privileged numbers"] = len(agent["privileged_normalizer.mean"])
    for name, ours in config.sizes().items():
        if sizes.get(name, ours) != ours:
            raise ConfigError(OPTION, init_from, f"that run has {sizes[name]} {name}, this one has {ours}; use another")
    for item in fields(source.agent):
        was, now = getattr(source.agent, item.name), getattr(config.agent, item.name)
        if was != now and item.name not in NOT_IN[parts]:
            fix = f"that run has {option(item.name)} {was}, this one has {now}; use the same"
            raise ConfigError(OPTION, init_from, fix)


def _begun(config: RunConfig, state: dict[str, Any], parts: InitParts, averages: bool) -> JointUpdate:
    """The run's own learner before its first update, with what is taken in its place."""
    update = make_update(initial_agent(config.window_spec(), config.agent, config.seed), config.update, config.seed)
    weights = {name: value for name, value in state["agent"].items() if name.startswith(PARTS[parts])}
    update.agent.load_state_dict(update.agent.state_dict() | weights)
    if update.ema_memory is not None:
        update.ema_memory.load_state_dict(update.agent.memory.state_dict())
    if update.target_critic is not None:
        critic = state["target_critic"] if parts == "all" else update.agent.critic.state_dict()
        update.target_critic.load_state_dict(critic)
    averaged = {name: value for name, value in state["average"].items() if averages and name in weights}
    update.average.load_state_dict({**update.agent.acting()} | averaged)
    return update


def _progress(spec: WindowSpec, agent: Agent, source: dict[str, Any], parts: InitParts) -> LearnerProgress:
    """Of a learner that has done nothing. What normalises what it reads weighs as much as the steps it is from.

    Those are of the ``source``, and of the run that it began with itself.
    """
    normalizers = [agent.normalizer, *([agent.privileged_normalizer] if agent.privileged_normalizer else [])]
    mean, std = (torch.cat([getattr(one, name) for one in normalizers]).double() for name in ("mean", "std"))
    before = source.get("observed_before")
    earlier = 0 if before is None else int(ObservationStatistics.from_json(before).count.max())
    seen = (mean != 0.0) | (std != 1.0)  # else as a normaliser begins
    count = (source["env_steps"] + earlier) * (seen if spec.counts > 1 else seen.any(0, keepdim=True))
    if parts != "all":
        count[spec.obs_dim :] = 0  # what critics alone read is new
    total, total_square = mean * count, (std.square() + mean.square()) * count
    observed = ObservationStatistics(count.numpy(), total.numpy(), total_square.numpy())
    return LearnerProgress(0, 0, 0, observed_before=observed, policy_learnt="policy.".startswith(PARTS[parts]))
