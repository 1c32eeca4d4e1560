"""The passive T-maze: is a cue at the first step remembered to the end of a corridor of L steps?

Best is 1. Beside the preset for it stand the default, and an agent without a memory, which makes 0 on average.
"""

from studies.study import Scale, Study

AGENTS = {
    "memory": "train ENV --preset memory",
    "robust": "train ENV",
    "without a memory": "train ENV --preset memory --head-input observation --no-grounding --no-impute-missing",
    "RecurrentPPO": "baseline recurrent-ppo ENV",
}
STUDY = Study("t_maze", AGENTS, small=Scale(100_000, (1, 2, 3), ("studies.t_maze_env:TMaze50-v0",)))

if __name__ == "__main__":
    STUDY.main()
