"""Half of the frames blank: what helps a memory to see through it, from ``robust`` as it was before batch norm."""

from studies.study import Study, before

WAYS = {
    "RMC": "",
    "told": "--missing-flag",
    "not filled": "--no-impute-missing",
    "not filled, told": "--no-impute-missing --missing-flag",
    "longer burn-in": "--burn-in 30",
    "longer windows": "--burn-in 20 --trained-steps 30",
    "observation beside": "--head-input hidden+observation",
    "no memory": "--head-input observation --hidden 8 --embedding 0 --no-grounding --scheme 2",
    "not averaged": "--policy-ema-updates 0",
    "clipped": "--clip-norm 40 --policy-ema-updates 0",
    "scheme 1": "--scheme 1 --clip-norm 40 --policy-ema-updates 0",
}
STUDY = Study("blanks", {name: before(f"--flicker 0.5 {words}") for name, words in WAYS.items()})

if __name__ == "__main__":
    STUDY.main()
