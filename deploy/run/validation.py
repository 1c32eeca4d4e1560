"""Which configurations make no sense; numbers of the environment are judged in ``common/env/config.py``."""

from rmc.common.bus.redis_url import redacted
from rmc.common.env.config import EnvConfig, check_env_config, check_range
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig, WindowConfig
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.option_names import flat, option

RANGES: dict[str, tuple[float, float]] = {  # both ends included
    "seed": (0, 2**63 - 1),
    "total_steps": (1, 2**53),
    "actors": (1, 4096),
    "window.burn_in": (0, 10_000),
    "window.trained_steps": (1, 10_000),
    "agent.hidden": (1, 65_536),
    "agent.embedding": (0, 65_536),
    "actor.envs_per_actor": (1, 4096),
    "actor.reward_scale": (1e-37, 1e37),
    "actor.refresh_steps": (1, 2**31),
    "actor.chunk_windows": (1, 65_536),
    "actor.chunk_seconds": (1e-3, 3600),
    "actor.unacked_bytes": (1 << 20, 1 << 40),
    "replay.capacity": (1, 2**40),
    "replay.replay_ratio": (1e-6, 1e9),
    "replay.warmup_steps": (0, 2**53),
    "replay.priority_exponent": (0, 4),
    "replay.replay_shards": (1, 1024),
    "update.learning_rate": (1e-12, 1),
    "update.memory_learning_scale": (0, 1_000),
    "update.alpha_learning_rate": (0, 1),
    "update.target_entropy": (-100, 0.69),  # log 2 is that of a uniform action
    "update.gamma": (0, 1),
    "update.polyak": (0, 1),
    "update.clip_norm": (0, 1e12),
    "update.curiosity": (0, 1e12),
    "update.curiosity_steps": (1, 2**53),
    "update.scheme": (1, 6),
    "update.policy_delay": (1, 1_000),
    "update.n_step": (1, 10_000),
    "update.eta": (0, 1),
    "update.policy_ema_updates": (0, 2**31),
    "learner.batch_size": (1, 65_536),
    "learner.importance_exponent": (0, 1),
    "learner.publish_updates": (1, 2**31),
    "learner.checkpoint_steps": (1, 2**53),
    "learner.keep_checkpoints": (1, 1_000_000),
    "learner.threads": (0, 1024),
    "evaluator.episodes": (0, 10_000),
    "evaluator.evaluation_seconds": (0, 1e9),
}


def validate(config: RunConfig) -> None:
    """Raises ConfigError for the first value that makes no sense."""
    check_env_config(config.env)
    values = flat(config)
    for path, limits in RANGES.items():
        check_range(option(path), values[path], limits)
    _validate_agent(config)
    _validate_actors(config)
    if config.total_steps <= config.replay.warmup_steps:
        fix = f"take more than --warmup-steps={config.replay.warmup_steps}, which a new run may lower"
        raise ConfigError("--total-steps", config.total_steps, fix)


def _validate_agent(config: RunConfig) -> None:
    if min(config.agent.heads) < 1:
        raise ConfigError("--heads", config.agent.heads, "take at least 1 unit a layer")
    if config.agent.head_input == "observation" and config.update.curiosity:
        raise ConfigError("--curiosity", config.update.curiosity, "it is the error in a memory's change; take 0")
    if config.agent.initial_priority == "actor" and config.replay.priority_exponent == 0.0:
        raise ConfigError(
            "--initial-priority", "actor", "uniform replay has no priorities; try --priority-exponent 0.6"
        )
    if config.agent.missing_flag and config.env.frame_stack > 1:
        raise ConfigError("--missing-flag", True, "a stack of frames has no flag; leave it, or use --frame-stack 1")
    if config.agent.impute_missing and not config.agent.normalize_observations:
        fix = "it takes --normalize-observations; or leave missing frames as they are: --no-impute-missing"
        raise ConfigError("--impute-missing", True, fix)
    if not config.update.policy_through_q and config.update.scheme < 4:
        raise ConfigError("--policy-through-q", False, "schemes 1 to 3 have no such way; take --scheme 4, 5 or 6")


def _validate_actors(config: RunConfig) -> None:
    if config.replay.replay_shards > config.actors:
        fix = f"every shard needs an actor: take at most --actors={config.actors}"
        raise ConfigError("--replay-shards", config.replay.replay_shards, fix)
    if config.actors % config.replay.replay_shards:
        fix = f"every shard has as many actors: take a multiple of --replay-shards={config.replay.replay_shards}"
        raise ConfigError("--actors", config.actors, fix)
    if not 0 <= config.actor.stride <= config.window.trained_steps:
        raise ConfigError("--stride", config.actor.stride, f"take 0 to --trained-steps={config.window.trained_steps}")
    if config.actor.stride and config.actor.state_strategy == "episode":
        raise ConfigError("--stride", config.actor.stride, "an episode is one window; leave it, or use burn-in")


def validate_new(config: RunConfig) -> None:
    """Raises ConfigError for what a new run would have no use for. A run that has begun may have it."""
    window, default, strategy = config.window, WindowConfig(), config.actor.state_strategy
    if strategy == "episode" and window.trained_steps != default.trained_steps:
        fix = "an episode is one window; leave it, or take --state-strategy burn-in"
        raise ConfigError("--trained-steps", window.trained_steps, fix)
    if strategy != "burn-in" and window.burn_in not in (0, default.burn_in):
        fix = f"--state-strategy {strategy} has no burn-in; leave it, or take --state-strategy burn-in"
        raise ConfigError("--burn-in", window.burn_in, fix)
    if config.agent.missing_flag and config.agent.head_input == "observation":
        raise ConfigError(
            "--missing-flag", True, "the memory reads it, and --head-input observation has none; leave it"
        )
    if config.update.n_step > window.trained_steps and strategy != "episode":
        fix = f"a return has as many steps as are trained: take at most --trained-steps={window.trained_steps}"
        raise ConfigError("--n-step", config.update.n_step, fix)
    validate_new_env(config.env)


def validate_new_env(env: EnvConfig) -> None:
    """Raises ConfigError for what would change nothing."""
    if env.flicker_burst > 1.0 and not (env.flicker or env.drop_sensors):
        raise ConfigError("--flicker-burst", env.flicker_burst, "nothing is missing; give --flicker, too")


def validate_launch(config: RunConfig, options: LaunchOptions) -> None:
    """``validate``, and raises ConfigError for options that the launcher has no use for, or lacks."""
    validate(config)
    launcher = options.launcher
    _validate_ray(options)
    if launcher == "lockstep" and options.redis_url is not None:
        raise ConfigError("--redis-url", redacted(options.redis_url), "a lockstep run has no use for one; leave it")
    if launcher == "lockstep" and config.replay.replay_shards > 1:
        fix = "a lockstep run has one; use --launcher local"
        raise ConfigError("--replay-shards", config.replay.replay_shards, fix)
    if options.init_parts != "all" and options.init_from is None:
        raise ConfigError("--init-parts", options.init_parts, "say whose: give --init-from RUN, or leave it")
    if launcher == "manual" and options.redis_url is None:
        raise ConfigError("--redis-url", None, "say which Redis the roles that you start by hand will use")


def _validate_ray(options: LaunchOptions) -> None:
    """What a run on Ray may not have, and what it alone may have."""
    launcher = options.launcher
    if launcher == "ray" and options.redis_url is not None:
        fix = "a run on Ray has a Redis of its own, on the head"
        raise ConfigError("--redis-url", redacted(options.redis_url), fix)
    if launcher == "ray" and options.device not in ("cpu", "cuda"):
        raise ConfigError("--device", options.device, "take cpu or cuda; Ray says which GPU")
    if launcher != "ray" and options.all_cpus:
        raise ConfigError("--all-cpus", True, "give --launcher ray; elsewhere say how many --actors")
    if launcher != "ray" and options.tls:
        raise ConfigError("--tls", True, "give --launcher ray; elsewhere take a --redis-url of rediss://")
    if launcher != "ray" and options.ray_address != "auto":
        raise ConfigError("--ray-address", options.ray_address, "give --launcher ray, or leave it")
