"""Half of the frames blank: what helps a memory to see through it?"""

from studies.study import Study

WAYS = {
    "filled: robust": "",
    "filled, told": "--blank-flag",
    "o itself": "--no-fill-blanks",
    "o itself, told": "--no-fill-blanks --blank-flag",
    "change": "--no-fill-blanks --grounding change",
    "change, told": "--no-fill-blanks --grounding change --blank-flag",
    "longer burn-in": "--burn-in 30",
    "longer windows": "--burn-in 20 --trained-steps 30",
    "observation beside": "--no-fill-blanks --head-input hidden+observation",
    "no grounding": "--no-fill-blanks --grounding off",
}
STUDY = Study("blanks", {name: f"train ENV --flicker 0.5 {words}" for name, words in WAYS.items()})

if __name__ == "__main__":
    STUDY.main()
