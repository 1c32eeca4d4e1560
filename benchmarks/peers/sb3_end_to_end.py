"""stable-baselines3's SAC, a line for each evaluation; torch takes a thread a core, the fastest here.

python sb3_end_to_end.py ENV SEED EVERY EPISODES LEARNING_STARTS
"""

import sys

import gymnasium as gym
import torch
from evaluation import Evaluation
from stable_baselines3 import SAC

ENDLESS = 10_000_000


def main() -> None:
    env_id, (seed, every, episodes, learning_starts) = sys.argv[1], (int(word) for word in sys.argv[2:])
    torch.set_flush_denormal(True)
    model = SAC("MlpPolicy", gym.make(env_id), seed=seed, device="cpu", learning_starts=learning_starts)
    model.learn(ENDLESS, Evaluation(env_id, every, episodes))


if __name__ == "__main__":
    main()
