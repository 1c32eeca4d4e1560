"""A trained policy as a library: step it in a loop of your own.

    policy = load_policy("runs/first")
    env = policy.make_env()
    observation, info = env.reset()
    policy.reset()
    action = policy.act(observation, info.get("missing", False))
    observation, reward, terminated, truncated, info = env.step(action)

Shapes: O observation, A action, S state.
"""

from pathlib import Path

import numpy as np

from rmc.actors.policy_runner import PolicyRunner
from rmc.analysis.evaluation import load_checkpoint
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env, Floats
from rmc.common.errors import ConfigError
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder


def load_policy(run: str | Path, checkpoint: str = "latest") -> "Policy":
    """The policy of a run's ``latest``, ``best`` or numbered checkpoint. Raises ConfigError."""
    folder = RunFolder(Path(run))
    config = folder.config()
    _, blob = load_checkpoint(folder, config, checkpoint)
    return Policy(config, blob)


class Policy:
    """Acts in one environment, and remembers: ``reset`` at the start of every episode, then ``act`` at every step."""

    def __init__(self, config: RunConfig, blob: bytes, seed: int = 0) -> None:
        """``blob`` is the safetensors of a policy; ``seed`` is for actions that explore. Raises MessageError."""
        spec = config.window_spec()
        self.config, self._obs_dim = config, spec.obs_dim
        self._runner = PolicyRunner(spec.obs_dim, spec.action_dim, config.agent, envs=1)
        self._runner.load(blob)
        self._rng = np.random.default_rng(seed)
        self.reset()

    def make_env(self) -> Env:
        """An environment as the policy saw it in training: actions in [-1, 1], and all that the run's options hide."""
        return make_env(self.config.env)

    def reset(self) -> None:
        """Forget: a new episode begins."""
        self._prev_action, self._state = self._runner.start()

    def act(self, observation: Floats, missing: bool = False, explore: bool = False) -> Floats:
        """(O,) -> (A,) in [-1, 1]: the policy's mean, or a sample of it.

        ``missing`` says that the frame is missing (``info["missing"]`` under flicker). A policy that fills missing
        frames also takes one that is not finite for missing. Raises ConfigError for any other that it cannot read.
        """
        noise = self._rng.standard_normal(self._prev_action.shape, np.float32) if explore else None
        seen, missing = self._read(observation, missing)
        action, state = self._runner.act(seen, self._prev_action, np.array([missing]), self._state, noise)
        self._prev_action, self._state[:] = action, state
        found: Floats = action[0].copy()
        return found

    def _read(self, observation: Floats, missing: bool) -> tuple[Floats, bool]:
        """(O,) -> (1, O), and whether it counts as missing. Raises ConfigError; nothing is remembered of it then."""
        with np.errstate(over="ignore"):  # infinity, which is judged below
            seen = np.asarray(observation, np.float32)
        if seen.shape != (self._obs_dim,):
            raise ConfigError("observation", f"of shape {seen.shape}", f"the policy reads shape {(self._obs_dim,)}")
        if not (missing or np.isfinite(seen).all()):
            missing = True
            if not self.config.agent.impute_missing:
                odd = {i: float(seen[i]) for i in np.flatnonzero(~np.isfinite(seen)).tolist()}
                raise ConfigError("observation", odd, "give finite numbers, or missing=True where there is none")
        return seen[None], missing
