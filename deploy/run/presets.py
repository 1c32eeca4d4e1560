"""The presets: where a run's defaults come from."""

from dataclasses import replace

from rmc.actors.config import ActorConfig, EvaluatorConfig
from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.config import Preset, RunConfig
from rmc.learner.config import LearnerConfig, UpdateConfig
from rmc.replay_server.config import ReplayConfig


def preset_config(name: Preset, env: EnvConfig | str) -> RunConfig:
    """A preset's RunConfig for an environment, by its config or its id."""
    return {"robust": robust, "memory": memory, "paper": paper, "debug": debug}[name](env)


def _env(env: EnvConfig | str) -> EnvConfig:
    return EnvConfig(env) if isinstance(env, str) else env


def robust(env: EnvConfig | str) -> RunConfig:
    """The default: the paper's agent with later improvements."""
    return RunConfig(
        env=_env(env),
        preset="robust",
        agent=AgentConfig(
            head_input="hidden+observation", normalize_observations=True, impute_missing=True, critic_batch_norm=True
        ),
        actor=ActorConfig(envs_per_actor=8),
        replay=ReplayConfig(replay_ratio=96.0, priority_exponent=0.0),
        update=UpdateConfig(target_entropy=-0.5, scheme=3, policy_ema_updates=2_000, policy_delay=2),
        learner=LearnerConfig(batch_size=16, publish_updates=80),
    )


def memory(env: EnvConfig | str) -> RunConfig:
    """For what is seen once and needed long after: whole episodes as windows, a memory that begins by holding on."""
    base = robust(env)
    return replace(
        base,
        preset="memory",
        agent=replace(base.agent, gate_init="chrono", head_input="hidden", critic_batch_norm=False),
        actor=replace(base.actor, state_strategy="episode"),
        replay=replace(base.replay, capacity=10_000, replay_ratio=48.0),
        update=replace(base.update, target_entropy=-1.0, scheme=1, policy_delay=1),
        learner=replace(base.learner, batch_size=8, publish_updates=10),  # one of long windows is worth many steps
    )


def paper(env: EnvConfig | str) -> RunConfig:
    """What the paper and its authors' code say."""
    return RunConfig(
        env=_env(env),
        preset="paper",
        agent=AgentConfig(embedding=0, grounding=False),
        actor=ActorConfig(envs_per_actor=8),
        replay=ReplayConfig(warmup_steps=10_000),
        update=UpdateConfig(learning_rate=1e-4, alpha_learning_rate=1e-5, policy_q="first", curiosity=0.5),
    )


def debug(env: EnvConfig | str) -> RunConfig:
    """Small and short: every part runs, within a minute on two cores."""
    return RunConfig(
        env=_env(env),
        preset="debug",
        total_steps=4_000,
        agent=AgentConfig(hidden=32, embedding=32, heads=(64, 64)),
        actor=ActorConfig(envs_per_actor=2),
        replay=ReplayConfig(capacity=2_000, replay_ratio=32.0, warmup_steps=500),
        learner=LearnerConfig(batch_size=16, checkpoint_steps=1_000, precision="fp32"),
        evaluator=EvaluatorConfig(episodes=2),
    )
