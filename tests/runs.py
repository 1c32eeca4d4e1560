"""Runs that nobody trains."""

import dataclasses
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save

from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.checkpoint import STATE, CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.opening import open_run
from rmc.deploy.run.presets import debug

AGENTS = {
    "robust": AgentConfig(
        hidden=16, embedding=12, heads=(10, 9), head_input="hidden+observation", normalize_observations=True
    ),
    "plain": AgentConfig(hidden=16, embedding=12, heads=(10, 9)),
    "observation beside": AgentConfig(hidden=16, embedding=12, heads=(10, 9), head_input="hidden+observation"),
    "without a memory": AgentConfig(hidden=16, embedding=12, heads=(10, 9), head_input="observation"),
    "filling blanks": AgentConfig(
        hidden=16, embedding=12, heads=(10, 9), normalize_observations=True, impute_missing=True
    ),
    "paper": AgentConfig(hidden=16, embedding=0, heads=(10, 9), grounding=False),
}
RESULT = {
    "env_steps": 1500, "updates": 336, "wall_s": 21.0, "eval_return_mean": 11.5, "eval_return_std": 0.5,
    "eval_episodes": 10, "initial_return_mean": 5.0,
}  # fmt: skip


def untrained(path: Path, config: RunConfig | None = None, status: int | None = None) -> RunFolder:
    """A run's folder, opened by a launcher that has ended, with that ``status`` if it trained; also opened again."""
    folder = open_run(config or debug(EnvConfig("InvertedPendulum-v5")), LaunchOptions(path))
    folder.lock.release(status)
    return folder


def read_config(text: str | bytes) -> RunConfig:
    """That of a run whose ``config.json`` says so. Raises ConfigError."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "config.json").write_bytes(text.encode() if isinstance(text, str) else text)
        return RunFolder(Path(folder)).config()


def make_run(
    path: Path,
    agent_config: AgentConfig,
    env: str,
    flicker: float = 0.0,
    env_kwargs: dict[str, Any] | None = None,
    header: bool = True,
) -> RunFolder:
    """``run_of`` these and the preset debug."""
    env_config = EnvConfig(env, flicker=flicker, env_kwargs=env_kwargs or {})
    return run_of(path, dataclasses.replace(debug(env_config), agent=agent_config), header)


def run_of(path: Path, config: RunConfig, header: bool = True) -> RunFolder:
    """A run's folder with one checkpoint of an agent that was never trained; without ``header`` as of RMC 0.1.0."""
    folder, spec = untrained(path, config), config.window_spec()
    torch.manual_seed(0)
    agent = Agent(spec.obs_dim, spec.action_dim, config.agent)
    agent.normalizer.freeze(torch.tensor(10), torch.full((spec.obs_dim,), 2.0), torch.full((spec.obs_dim,), 30.0))
    progress = {"updates": 7, "env_steps": 70}
    metadata = dataclasses.replace(config.policy_header(), **progress).metadata() if header else None
    policy, state = save(agent.policy_weights(), metadata), io.BytesIO()
    torch.save({"agent": agent.state_dict()}, state)
    files = {"policy.safetensors": policy, "progress.json": json.dumps(progress).encode(), STATE: state.getvalue()}
    CheckpointFolder(folder.checkpoints).save(7, files)
    return folder
