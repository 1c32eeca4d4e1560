"""A cue at the first step, asked for after 40: whole episodes as windows."""

from studies.study import Scale, Study

STUDY = Study(
    "memory40",
    {"memory": "train ENV --preset memory --time-limit 44"},
    small=Scale(60_000, (1, 2, 3), ("tests.memory_env:Memory40-v0",)),
)

if __name__ == "__main__":
    STUDY.main()
