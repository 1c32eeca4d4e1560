"""SBX's SAC (stable-baselines3 in JAX), a line for each evaluation; 32 updates every 32 steps, in one call.

python sbx_end_to_end.py ENV SEED EVERY EPISODES
"""

import json
import sys

import gymnasium as gym
from sbx import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy

ENDLESS = 10_000_000
PACE = {"train_freq": 32, "gradient_steps": 32, "learning_starts": 10_000}  # the last is rl-zoo's for MuJoCo


class Evaluation(BaseCallback):
    """Plays so many deterministic episodes every so many steps."""

    def __init__(self, env_id: str, every: int, episodes: int) -> None:
        super().__init__()
        self._env, self._every, self._episodes = gym.make(env_id), every, episodes

    def _on_step(self) -> bool:
        if self.num_timesteps % self._every == 0:
            mean, _ = evaluate_policy(self.model, self._env, self._episodes, deterministic=True, warn=False)
            print(json.dumps({"steps": self.num_timesteps, "return": float(mean)}), flush=True)
        return True


def main() -> None:
    env_id, (seed, every, episodes) = sys.argv[1], (int(word) for word in sys.argv[2:])
    SAC("MlpPolicy", gym.make(env_id), seed=seed, **PACE).learn(ENDLESS, Evaluation(env_id, every, episodes))


if __name__ == "__main__":
    main()
