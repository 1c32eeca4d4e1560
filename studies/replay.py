"""Prioritized against uniform replay, with both initial priorities, and the paper's strategies for stored states."""

from studies.study import Study

PRIORITIZED = "--priority-exponent 0.6"
WAYS = {
    "uniform, stored and burned in": "",
    "prioritized": PRIORITIZED,
    "prioritized, by the actor at first": f"{PRIORITIZED} --initial-priority actor",
    "zero state": "--state-strategy zero",
    "stored state": "--state-strategy stored",
    "whole episodes": "--state-strategy episode --batch-size 1",
}
STUDY = Study("replay", {name: f"train ENV {words}" for name, words in WAYS.items()})

if __name__ == "__main__":
    STUDY.main()
