"""Transitions a second that stable-baselines3's SAC trains, networks of 400 and 300 units, on one thread or more.

python sb3_learner.py OBSERVATION ACTION BATCH THREADS
"""

import sys
from functools import partial

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from turns import speed, take_turns

TRANSITIONS = 50_000  # in its buffer
CHUNK = 10  # gradient steps a call, as it makes them between looks at its environment


class Nothing(gym.Env):
    """The sizes of an environment: it is not stepped."""

    def __init__(self, obs_dim: int, action_dim: int) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (action_dim,), np.float32)

    def reset(self, *, seed=None, options=None):
        """Zeros."""
        super().reset(seed=seed, options=options)
        return np.zeros(self.observation_space.shape, np.float32), {}


def main() -> None:
    obs_dim, action_dim, batch, threads = (int(word) for word in sys.argv[1:])
    torch.set_num_threads(threads)
    torch.set_flush_denormal(True)  # as ours
    env = Nothing(obs_dim, action_dim)
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [400, 300]}, buffer_size=TRANSITIONS, device="cpu", seed=0)
    model.set_logger(Logger(None, []))
    draw = np.random.default_rng(0)
    for _ in range(TRANSITIONS):
        now, then = draw.uniform(-1.0, 1.0, (2, 1, obs_dim)).astype(np.float32)
        action = draw.uniform(-1.0, 1.0, (1, action_dim)).astype(np.float32)
        model.replay_buffer.add(now, then, action, np.zeros(1, np.float32), np.zeros(1, bool), [{}])

    def train() -> int:
        model.train(gradient_steps=CHUNK, batch_size=batch)
        return CHUNK * batch

    speed(train, 1.0)
    take_turns(partial(speed, train))


if __name__ == "__main__":
    main()
