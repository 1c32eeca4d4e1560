"""The processes that play environments: actors and the evaluator."""

import os
from functools import partial

import torch

from rmc.actors.actor import Actor
from rmc.actors.evaluator import Evaluator
from rmc.common.errors import ConfigError
from rmc.common.process.role import run_role
from rmc.deploy.local.role_process import Process, RunConnection
from rmc.deploy.run.config import RunConfig
from rmc.learner.initial_priority import InitialPriority

ACTOR_IDLE_SECONDS = 0.01  # a waiting actor looks at Redis every 0.02 s
EVALUATOR_IDLE_SECONDS = 0.05  # and an evaluator every 0.1 s
EVALUATOR_NICENESS = 10  # it must not take the learner's core


def run_actor(place: RunConnection, index: int) -> None:
    """The process of actor ``index``."""
    process = Process(place)
    config = process.config
    if not 0 <= index < config.actors:
        raise ConfigError("--index", index, f"the run has actors 0 to {config.actors - 1}")
    torch.set_num_threads(1)
    spec, priority_fn = config.window_spec(), initial_priority(config, index)
    make_env = partial(process.make_env, config.agent.privileged_critic)
    with process.starting(f"actor-{index}"):
        bus, rate = process.bus, priority_fn
        actor = Actor(index, config.seed, make_env, spec, config.agent, config.actor, bus, priority_fn=rate)
    run_role(actor, process.bus, process.stop, idle_seconds=ACTOR_IDLE_SECONDS)


def initial_priority(config: RunConfig, index: int) -> InitialPriority | None:
    """What rates the windows of an actor, where actors do."""
    if config.agent.initial_priority == "max":
        return None
    return InitialPriority(config.window_spec(), config.agent, config.update, config.seed + index)


def run_evaluator(place: RunConnection) -> None:
    """The evaluator's process."""
    process = Process(place)
    config = process.config
    torch.set_num_threads(1)
    os.nice(EVALUATOR_NICENESS)
    missing = config.layout.missing
    with process.starting("evaluator"):
        bus = process.bus
        evaluator = Evaluator(config.seed, process.make_env, config.agent, config.evaluator, bus, missing=missing)
    run_role(evaluator, process.bus, process.stop, idle_seconds=EVALUATOR_IDLE_SECONDS)
