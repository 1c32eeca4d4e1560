"""What ``robust`` has and has not, one change at a time."""

from studies.study import Study

CHANGES = {
    "RMC": "",
    "prioritized": "--priority-exponent 0.6",
    "EMA latent": "--latent-target ema",
    "EMA memory": "--target-memory ema",
    "curiosity": "--curiosity 0.1 --curiosity-scale std",
    "raw observations": "--no-normalize-observations --no-impute-missing",
}
STUDY = Study("trial", {name: f"train ENV {words}" for name, words in CHANGES.items()})

if __name__ == "__main__":
    STUDY.main()
