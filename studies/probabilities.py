"""Trained and played with more and more frames blank: none of them, half of them, all of them."""

from studies.study import Study

PROBABILITIES = (0, 0.25, 0.5, 0.75, 0.9, 1)
STUDY = Study("probabilities", {f"p = {p}": f"train ENV --flicker {p}" for p in PROBABILITIES})

if __name__ == "__main__":
    STUDY.main()
