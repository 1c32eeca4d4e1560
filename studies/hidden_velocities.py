"""Velocities hidden: a memory beside a stack of frames and a recurrent PPO, on four of MuJoCo's bodies."""

from studies.study import Scale, Study

ENVS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5")
STUDY = Study(
    "hidden_velocities",
    {
        "RMC": "train ENV --hide velocities",
        "RMC, slow memory": "train ENV --hide velocities --memory-learning-scale 0.3",
        "SAC, 4 frames": "baseline sac ENV --hide velocities --frame-stack 4",
        "RecurrentPPO": "baseline recurrent-ppo ENV --hide velocities",
    },
    small=Scale(300_000, (1, 2), ENVS),
    full=Scale(1_000_000, (1, 2, 3, 4, 5), ENVS),
)

if __name__ == "__main__":
    STUDY.main()
