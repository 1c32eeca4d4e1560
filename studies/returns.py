"""Figures (a) to (e) of the paper: returns where everything is seen, beside DDPG, PPO, TD3 and SAC."""

from studies.study import Scale, Study, before, earlier

ENVS = ("Ant-v5", "HalfCheetah-v5", "Humanoid-v5", "Walker2d-v5", "HumanoidStandup-v5")
NO_CONTACT_FORCES = "--env-kwargs include_cfrc_ext_in_observation=false"  # as Ant-v4's
CROSSQ = (
    "--head-input observation --hidden 8 --embedding 0 --no-impute-missing --no-grounding --scheme 2 --burn-in 0 "
    "--trained-steps 1 --capacity 110000 --batch-size 256 --replay-ratio 256 --policy-delay 3 --learning-rate 1e-3 "
    "--alpha-learning-rate 1e-3"
)
OURS = {
    "RMC": "train ENV",
    "RMC, target entropy -A": earlier(),
    "RMC, an update a step": earlier("--replay-ratio 240"),
    "RMC, 1e-3": earlier("--learning-rate 1e-3 --alpha-learning-rate 1e-3 --memory-learning-scale 0.3"),
    "CrossQ's form": earlier(CROSSQ),
    "CrossQ's form, no contact forces": earlier(f"{CROSSQ} {NO_CONTACT_FORCES}"),
    "RMC, rewards times 0.01": "train ENV --reward-scale 0.01",  # of HumanoidStandup-v5, whose are in the hundreds
    "RMC, target entropy -A, rewards times 0.01": earlier("--reward-scale 0.01"),
    "RMC, heads of 1024": "train ENV --heads 1024 1024",
    "RMC, no contact forces": f"train ENV {NO_CONTACT_FORCES}",
    "RMC, target entropy -A, no contact forces": earlier(NO_CONTACT_FORCES),
    "RMC, h alone": earlier("--head-input hidden"),
    "RMC, policy at every update": earlier("--head-input hidden --policy-delay 1"),
    "RMC, target critics": before(),
    "RMC, not averaged": before("--policy-ema-updates 0"),
    "RMC paper": "train ENV --preset paper",
}
THEIRS = {name: f"baseline {name.lower()} ENV" for name in ("SAC", "CrossQ", "TD3", "DDPG", "PPO")}
TUNED = {f"{name} zoo": f"{words} --settings zoo" for name, words in THEIRS.items()}
STUDY = Study(
    "returns",
    OURS | THEIRS | TUNED,
    small=Scale(300_000, (1, 2, 3), ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")),
    full=Scale(1_000_000, (1, 2, 3, 4, 5), ENVS),
)

if __name__ == "__main__":
    STUDY.main()
