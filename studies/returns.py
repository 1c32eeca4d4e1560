"""Figures (a) to (e) of the paper: returns where everything is seen, beside DDPG, PPO, TD3 and SAC."""

from studies.study import Scale, Study, before

ENVS = ("Ant-v5", "HalfCheetah-v5", "Humanoid-v5", "Walker2d-v5", "HumanoidStandup-v5")
OURS = {
    "RMC": "train ENV",
    "RMC, h alone": "train ENV --head-input hidden",
    "RMC, policy at every update": "train ENV --head-input hidden --policy-delay 1",
    "RMC, target critics": before(),
    "RMC, not averaged": before("--policy-ema-updates 0"),
    "RMC paper": "train ENV --preset paper",
}
THEIRS = {name: f"baseline {name.lower()} ENV" for name in ("SAC", "TD3", "DDPG", "PPO")}
TUNED = {f"{name} zoo": f"{words} --settings zoo" for name, words in THEIRS.items()}
STUDY = Study(
    "returns",
    OURS | THEIRS | TUNED,
    small=Scale(300_000, (1, 2, 3), ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")),
    full=Scale(1_000_000, (1, 2, 3, 4, 5), ENVS),
)

if __name__ == "__main__":
    STUDY.main()
