"""From SAC towards RMC, one thing at a time: where does the return go, or come from?

The first rung is stable-baselines3's SAC with its own defaults; the second the same through our actors, replay server
and learner. Every later one keeps what the one before has, as far as it is not the thing that changes.
"""

from studies.study import Scale, Study, before

ALONE = "--head-input observation --hidden 8 --embedding 0"  # the agent without a memory
BARE = "--no-impute-missing --no-grounding"
RAW = f"--no-normalize-observations {BARE} --scheme 2 {ALONE}"
FLAT = f"--heads 256 256 --burn-in 0 {RAW}"
EVERY_STEP = "--policy-ema-updates 0 --envs-per-actor 1 --replay-ratio 256"
RUNGS = {
    "SAC": "baseline sac ENV --settings default",
    "through our pipeline": before(
        f"{FLAT} {EVERY_STEP} --batch-size 256 --trained-steps 1 --chunk-windows 1 --capacity 1000000"
    ),
    "windows of 16": before(f"{FLAT} {EVERY_STEP} --batch-size 16 --trained-steps 16"),
    "8 environments, an update every 2.5 steps, averaged": before(FLAT),
    "heads 400 300": before(RAW),
    "normalised observations": before(f"{BARE} --scheme 2 {ALONE}"),
    "a memory beside o": before(f"{BARE} --scheme 2 --head-input hidden+observation"),
    "a memory alone": before(f"{BARE} --scheme 2"),
    "the model's loss": before(f"{BARE} --scheme 1"),
    "grounding": before("--scheme 1"),
}
STUDY = Study("ladder", RUNGS, small=Scale(60_000, (1, 2)))

if __name__ == "__main__":
    STUDY.main()
