"""Scales of curiosity, as the paper's generalisation (c): beta_0 none, small, the paper's and huge, on HalfCheetah.

``--env MountainCarContinuous-v0 --steps 30000`` is where it is needed: the reward is at the goal alone.
"""

from studies.study import Study

SCALES = {"none": 0.0, "small": 0.05, "the paper's": 0.5, "huge": 50.0}
AGENTS = {name: f"train ENV --curiosity {beta}" for name, beta in SCALES.items()}
STUDY = Study(
    "curiosity", AGENTS | {"huge, gone after 15 000 steps": "train ENV --curiosity 50 --curiosity-steps 15000"}
)

if __name__ == "__main__":
    STUDY.main()
