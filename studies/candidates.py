"""What one update is worth: one change at a time, at 60 000 steps.

BEFORE changes 32 windows a batch, with scheme 1, clipped at 40 and not averaged, which were the default then; what
names no batch has 32. TARGETS changes what was the default before batch norm.
"""

from studies.study import Scale, Study, before

BEFORE = {
    "batch 32": "--batch-size 32",
    "batch 16": "--batch-size 16",
    "polyak 0.98": "--batch-size 32 --polyak 0.98",
    "learning rate 1e-3": "--batch-size 32 --learning-rate 1e-3",
    "n-step 3": "--batch-size 32 --n-step 3",
    "heads 256 256": "--batch-size 32 --heads 256 256",
    "batch 8": "--batch-size 8",
    "batch 8, temperature's rate 1e-3": "--batch-size 8 --alpha-learning-rate 1e-3",
    "batch 4, ratio 24": "--batch-size 4 --replay-ratio 24",
    "batch 16, n-step 3": "--batch-size 16 --n-step 3",
    "batch 16, observation beside": "--batch-size 16 --head-input hidden+observation",
}
TARGETS = {
    "RMC": "",
    "RMC, memory's rate 0.3": "--memory-learning-scale 0.3",
    "RMC, first critic": "--policy-q first",
    "RMC, optimisers apart": "--update-order alternate",
    "RMC, clipped by part": "--update-order alternate --clip-norm 40",
    "RMC, stride 5": "--stride 5",
    "RMC, reward scale 5": "--reward-scale 5",
    "RMC, reward scale 0.2": "--reward-scale 0.2",
    "RMC, ratio 24": "--replay-ratio 24",
    "RMC, ratio 96": "--replay-ratio 96",
    "RMC, batch 4, ratio 24": "--batch-size 4 --replay-ratio 24",
    "RMC, batch 16, ratio 96": "--batch-size 16 --replay-ratio 96",
}
STUDY = Study(
    "candidates",
    {name: before(f"--scheme 1 --clip-norm 40 --policy-ema-updates 0 {words}") for name, words in BEFORE.items()}
    | {name: before(words) for name, words in TARGETS.items()},
    small=Scale(60_000, (1, 2)),
)

if __name__ == "__main__":
    STUDY.main()
