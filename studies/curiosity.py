"""Generalisation (c) of the paper: scales of curiosity, beta_0 none, small, the paper's and huge, on HalfCheetah."""

from studies.study import Study

SCALES = {"none": 0.0, "small": 0.05, "the paper's": 0.5, "huge": 50.0}
STUDY = Study("curiosity", {name: f"train ENV --curiosity {beta}" for name, beta in SCALES.items()})

if __name__ == "__main__":
    STUDY.main()
