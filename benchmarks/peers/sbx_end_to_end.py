"""SBX's SAC (stable-baselines3 in JAX), a line for each evaluation; so many updates every so many steps, in one call.

python sbx_end_to_end.py ENV SEED EVERY EPISODES STEPS THREADS
"""

import os
import sys

ENV_ID, (SEED, EVERY, EPISODES, STEPS, THREADS) = sys.argv[1], (int(word) for word in sys.argv[2:])
if THREADS == 1:  # before JAX is imported
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import gymnasium as gym  # noqa: E402
from evaluation import Evaluation  # noqa: E402
from sbx import SAC  # noqa: E402

ENDLESS = 10_000_000
LEARNING_STARTS = 10_000  # rl-zoo's for MuJoCo


def main() -> None:
    pace = {"train_freq": STEPS, "gradient_steps": STEPS, "learning_starts": LEARNING_STARTS}
    SAC("MlpPolicy", gym.make(ENV_ID), seed=SEED, **pace).learn(ENDLESS, Evaluation(ENV_ID, EVERY, EPISODES))


if __name__ == "__main__":
    main()
