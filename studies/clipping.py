"""The gradient clipped, which an Adam step hardly needs, and which makes the rare fall in a batch weigh less."""

from studies.study import Scale, Study

STUDY = Study(
    "clipping",
    {
        "not clipped": "train ENV --policy-ema-updates 0",
        "clipped at 40": "train ENV --policy-ema-updates 0 --clip-norm 40",
    },
    small=Scale(100_000, (1, 2, 3), ("HalfCheetah-v5", "Hopper-v5")),
)

if __name__ == "__main__":
    STUDY.main()
