"""Sensors that fail one by one, more and more of them, at once or in bursts: what is a memory worth?

Without a memory, the heads read the observation as it is, zeros in place of what is missing.
"""

from itertools import product

from studies.study import Study

PROBABILITIES, BURSTS = (0, 0.1, 0.3, 0.5, 0.7), (1, 10)
AGENTS = {
    "RMC": "",
    "no memory": "--head-input observation --hidden 8 --embedding 0 --no-grounding --scheme 2 --no-impute-missing",
}


def _name(agent: str, probability: float, burst: int) -> str:
    return f"{agent}, p = {probability}{f', bursts of {burst}' if burst > 1 else ''}"


STUDY = Study(
    "missing_sensors",
    {
        _name(agent, p, burst): f"train ENV {words} --drop-sensors {p} --flicker-burst {burst}"
        for (agent, words), p, burst in product(AGENTS.items(), PROBABILITIES, BURSTS)
        if p or burst == 1  # where nothing is missing, nothing comes in bursts
    },
)

if __name__ == "__main__":
    STUDY.main()
