"""Half of the frames blank: what helps a memory to see through it?"""

from studies.study import Study

WAYS = {
    "robust": "",
    "told which are blank": "--blank-flag",
    "grounded by o itself": "--grounding observation",
    "o itself, told": "--grounding observation --blank-flag",
    "filled": "--grounding observation --fill-blanks",
    "filled, told": "--grounding observation --fill-blanks --blank-flag",
    "longer burn-in": "--burn-in 30",
    "longer windows": "--burn-in 20 --trained-steps 30",
    "observation beside": "--head-input hidden+observation",
    "no grounding": "--grounding off",
}
STUDY = Study("blanks", {name: f"train ENV --flicker 0.5 {words}" for name, words in WAYS.items()})

if __name__ == "__main__":
    STUDY.main()
