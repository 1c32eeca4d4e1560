"""The processes that play environments: actors and the evaluator."""

import os
import time
from collections.abc import Callable
from functools import partial

import torch

from rmc.actors.actor import Actor
from rmc.actors.evaluator import Evaluator
from rmc.common.bus.protocol import Bus, actor_role
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError
from rmc.common.process.role import run_role
from rmc.deploy.local.role_context import RoleContext, RunConnection
from rmc.deploy.run.config import RunConfig
from rmc.learner.initial_priority import InitialPriority

ACTOR_IDLE_SECONDS = 0.01  # a waiting actor looks at Redis every 0.02 s
EVALUATOR_IDLE_SECONDS = 0.05  # and an evaluator every 0.1 s
EVALUATOR_NICENESS = 10  # it must not take the learner's core


def run_actor(connection: RunConnection, index: int) -> int:
    """The process of actor ``index``."""
    process = RoleContext(connection)
    config = process.config
    if not 0 <= index < config.actors:
        raise ConfigError("--index", index, f"the run has actors 0 to {config.actors - 1}")
    torch.set_num_threads(1)
    make_env = partial(process.make_env, config.agent.privileged_critic)
    with process.starting(actor_role(index)):
        actor = make_actor(config, index, make_env, process.bus)
    run_role(actor, process.bus, process.stop, idle_seconds=ACTOR_IDLE_SECONDS)
    return process.stop.exit_status


def make_actor(
    config: RunConfig, index: int, make_env: Callable[[], Env], bus: Bus, clock: Callable[[], float] = time.monotonic
) -> Actor:
    """A run's actor; it rates its own windows where the config says so."""
    spec, agent = config.window_spec(), config.agent
    actors_rate = agent.initial_priority == "actor"
    priority = InitialPriority(spec, agent, config.update) if actors_rate else None
    return Actor(index, config.seed, make_env, spec, agent, config.actor, bus, clock, priority)


def make_evaluator(
    config: RunConfig, make_env: Callable[[], Env], bus: Bus, clock: Callable[[], float] = time.monotonic
) -> Evaluator:
    """A run's evaluator."""
    return Evaluator(config.seed, make_env, config.agent, config.evaluator, bus, clock, config.layout.missing)


def run_evaluator(connection: RunConnection) -> int:
    """The evaluator's process."""
    process = RoleContext(connection)
    config = process.config
    torch.set_num_threads(1)
    os.nice(EVALUATOR_NICENESS)
    with process.starting("evaluator"):
        evaluator = make_evaluator(config, process.make_env, process.bus)
    run_role(evaluator, process.bus, process.stop, idle_seconds=EVALUATOR_IDLE_SECONDS)
    return process.stop.exit_status
