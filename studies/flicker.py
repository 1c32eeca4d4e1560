"""Figure (f) of the paper: half of the frames blank, RMC beside SAC with a stack of frames and a recurrent PPO.

What each makes of full observation is the ceiling.
"""

from studies.study import Scale, Study, before, earlier

ENVS = ("Ant-v5", "HalfCheetah-v5", "Humanoid-v5", "Walker2d-v5", "HumanoidStandup-v5")
STUDY = Study(
    "flicker",
    {
        "RMC": "train ENV --flicker 0.5",
        "RMC, target entropy -A": earlier("--flicker 0.5"),
        "RMC, privileged critic": "train ENV --flicker 0.5 --privileged-critic",
        "RMC, an update a step": earlier("--flicker 0.5 --replay-ratio 240"),
        "RMC, 1e-3": earlier(
            "--flicker 0.5 --learning-rate 1e-3 --alpha-learning-rate 1e-3 --memory-learning-scale 0.3"
        ),
        "RMC, policy at every update": earlier("--flicker 0.5 --head-input hidden --policy-delay 1"),
        "RMC, target critics": before("--flicker 0.5"),
        "SAC, 4 frames": "baseline sac ENV --flicker 0.5 --frame-stack 4",
        "RecurrentPPO": "baseline recurrent-ppo ENV --flicker 0.5",
        "RMC, all seen": "train ENV",
        "SAC, all seen": "baseline sac ENV",
    },
    full=Scale(1_000_000, (1, 2, 3, 4, 5), ENVS),
)

if __name__ == "__main__":
    STUDY.main()
