"""An agent of SBX (stable-baselines3 in JAX) trains; a line of JSON for each evaluation.

python sbx_run.py SAC HalfCheetah-v5 1 --every 5000 [--steps N] [--together 32] [--starts 10000] [--heads 400 300]
"""

import argparse
import json

import gymnasium as gym
import numpy as np
import sbx
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise

ENDLESS = 10_000_000
FINAL_EPISODES = 10


class Evaluation(BaseCallback):
    """Plays deterministic episodes every so many steps, and more of them after the last one."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__()
        self._options, self._env = options, gym.make(options.env)
        self._env.reset(seed=options.seed + 1_000_000)  # none of training's episodes

    def _on_step(self) -> bool:
        last = self.num_timesteps == self._options.steps
        if last or self.num_timesteps % self._options.every == 0:
            episodes = FINAL_EPISODES if last else self._options.episodes
            mean, deviation = evaluate_policy(self.model, self._env, episodes, deterministic=True, warn=False)
            updates = self.model._n_updates
            said = {"steps": self.num_timesteps, "updates": updates, "return": float(mean), "std": float(deviation)}
            print(json.dumps(said), flush=True)
        return not last


def model(options: argparse.Namespace) -> sbx.SAC | sbx.TD3 | sbx.DDPG:
    """New; what is not said is SBX's default. Without exploration of their own, TD3 and DDPG have noise of 0.1."""
    env = gym.make(options.env)
    said = {"train_freq": options.together, "gradient_steps": options.together, "learning_starts": options.starts}
    if options.algorithm != "SAC":
        said["action_noise"] = NormalActionNoise(np.zeros(env.action_space.shape), np.full(env.action_space.shape, 0.1))
    if options.heads:
        said["policy_kwargs"] = {"net_arch": options.heads}
    return getattr(sbx, options.algorithm)("MlpPolicy", env, seed=options.seed, **said)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", choices=["SAC", "TD3", "DDPG"])
    parser.add_argument("env")
    parser.add_argument("seed", type=int)
    parser.add_argument("--every", type=int, required=True, help="steps between evaluations")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--steps", type=int, default=ENDLESS)
    parser.add_argument("--together", type=int, default=1, help="steps, and as many updates, in one call")
    parser.add_argument("--starts", type=int, default=100, help="steps before the first update")
    parser.add_argument("--heads", type=int, nargs="+", default=[], help="units of each layer")
    options = parser.parse_args()
    model(options).learn(ENDLESS, Evaluation(options))


if __name__ == "__main__":
    main()
