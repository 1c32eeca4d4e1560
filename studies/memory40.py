"""A cue over 40 steps: windows that begin with zeros, or with a stored state that is burned in."""

from studies.study import Scale, Study

OPTIONS = (
    "--hidden 64 --embedding 64 --heads 128 128 --head-input hidden+embedding --normalize-observations "
    "--learning-rate 5e-4 --polyak 0.99 --target-memory ema --batch-size 16 --capacity 5000 --warmup-steps 1000 "
    "--priority-exponent 0 --episodes 10 --replay-ratio 96 --alpha-learning-rate 5e-3 --trained-steps 42 --stride 14"
)
WAYS = {name: f"train ENV {OPTIONS} --state-strategy {name}" for name in ("zero", "burn-in")}
STUDY = Study("memory40", WAYS, small=Scale(60_000, (1, 2, 3), ("tests.memory_env:Memory40-v0",)))

if __name__ == "__main__":
    STUDY.main()
