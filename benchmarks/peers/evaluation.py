"""What the peers' trainings share: an evaluation now and then, a line each."""

import json

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy


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
