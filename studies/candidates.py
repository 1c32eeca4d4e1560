"""What one update is worth: one change at a time from ``robust``, to find what moves the return at 60 000 steps."""

from studies.study import Scale, Study

CHANGES = {
    "robust": "",
    "ratio 96": "--replay-ratio 96",
    "batch 16": "--batch-size 16",
    "polyak 0.98": "--polyak 0.98",
    "learning rate 1e-3": "--learning-rate 1e-3",
    "n-step 3": "--n-step 3",
    "stride 5": "--stride 5",
    "prioritized": "--priority-exponent 0.6 --importance-exponent 0.4",
    "first critic": "--policy-q first",
    "no grounding": "--no-grounding",
    "reward scale 5": "--reward-scale 5",
    "heads 256 256": "--heads 256 256",
}
STUDY = Study(
    "candidates",
    {name: f"train ENV {words}" for name, words in CHANGES.items()},
    small=Scale(60_000, (1, 2)),
)

if __name__ == "__main__":
    STUDY.main()
