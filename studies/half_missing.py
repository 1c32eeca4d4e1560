"""Half of the frames blank for an agent that has learnt with all of them: does it fall back, and does it catch up?

Its first evaluation, of what it begins with, is that of an agent that never saw a blank frame. Beside it is one that
begins with nothing. With ``--jobs 1``, the runs that others begin with are trained before them.
"""

from studies.study import Study

STUDY = Study(
    "half_missing",
    {
        "all seen": "train ENV",
        "half missing": "train ENV --flicker 0.5",
        "half missing, after all seen": "train ENV --flicker 0.5 --init-from 'RUN:all seen'",
        "half missing, with its memory": "train ENV --flicker 0.5 --init-from 'RUN:all seen' "
        "--init-parts memory+world-model",
    },
)

if __name__ == "__main__":
    STUDY.main()
