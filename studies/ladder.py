"""From SAC to RMC, one thing at a time: where does the return go, or come from?

The first rung is stable-baselines3's SAC with its own defaults; the second the same through our actors, replay server
and learner. Every later one keeps what the one before has, as far as it is not the thing that changes.
"""

from studies.study import Scale, Study

ALONE = "--head-input observation --hidden 8 --embedding 0"  # the agent without a memory
BARE = "--no-fill-blanks --no-grounding --policy-average 0"
FLAT = f"--heads 256 256 --no-normalize-observations {BARE} --scheme 2 {ALONE}"
CLIPPED = "--clip-norm 40 --policy-average 0"
ONE = "--envs-per-actor 1 --chunk-windows 1 --burn-in 0 --capacity 1000000"
EVERY_STEP = "--replay-ratio 256 --batch-size"
RUNGS = {
    "SAC": "baseline sac ENV --settings default",
    "through our pipeline": f"train ENV {FLAT} {ONE} {EVERY_STEP} 256 --trained-steps 1",
    "windows of 16": f"train ENV {FLAT} --burn-in 0 {EVERY_STEP} 16 --trained-steps 16 --envs-per-actor 1",
    "8 environments": f"train ENV {FLAT} --burn-in 0 {EVERY_STEP} 16 --trained-steps 16",
    "an update every 10 steps": f"train ENV {FLAT} --burn-in 0",
    "heads 400 300, clipped": f"train ENV {CLIPPED} --no-normalize-observations {BARE} --scheme 2 {ALONE}",
    "normalised observations": f"train ENV {CLIPPED} {BARE} --scheme 2 {ALONE}",
    "a memory beside o": f"train ENV {CLIPPED} {BARE} --scheme 2 --head-input hidden+observation",
    "a memory alone": f"train ENV {CLIPPED} {BARE} --scheme 2",
    "the model's loss": f"train ENV {CLIPPED} {BARE} --scheme 1",
    "grounding": f"train ENV {CLIPPED} --scheme 1",
    "no value in the memory": f"train ENV {CLIPPED}",
    "not clipped": "train ENV --policy-average 0",
    "averaged, robust": "train ENV",
    "curiosity": "train ENV --curiosity 0.1 --curiosity-scale std",
}
STUDY = Study("ladder", RUNGS, small=Scale(60_000, (1, 2)))

if __name__ == "__main__":
    STUDY.main()
