"""stable-baselines3's SAC, a line for each evaluation; torch takes a thread a core, the fastest here.

python sb3_end_to_end.py ENV SEED EVERY EPISODES LEARNING_STARTS
"""

import json
import sys

import gymnasium as gym
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy

ENDLESS = 10_000_000


class Evaluation(BaseCallback):
    """Plays deterministic episodes now and then."""

    def __init__(self, env_id: str, every: int, episodes: int) -> None:
        super().__init__()
        self._env, self._every, self._episodes = gym.make(env_id), every, episodes

    def _on_step(self) -> bool:
        if self.num_timesteps % self._every == 0:
            mean, _ = evaluate_policy(self.model, self._env, self._episodes, deterministic=True, warn=False)
            print(json.dumps({"steps": self.num_timesteps, "return": float(mean)}), flush=True)
        return True


def main() -> None:
    env_id, (seed, every, episodes, learning_starts) = sys.argv[1], (int(word) for word in sys.argv[2:])
    torch.set_flush_denormal(True)
    model = SAC("MlpPolicy", gym.make(env_id), seed=seed, device="cpu", learning_starts=learning_starts)
    model.learn(ENDLESS, Evaluation(env_id, every, episodes))


if __name__ == "__main__":
    main()
