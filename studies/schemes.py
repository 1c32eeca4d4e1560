"""Generalisation (b) of the paper: which losses may reach the memory, its table 1, on HalfCheetah."""

from studies.study import Study

STUDY = Study("schemes", {f"scheme {scheme}": f"train ENV --scheme {scheme}" for scheme in range(1, 7)})

if __name__ == "__main__":
    STUDY.main()
