"""PyBullet's walkers with their positions or their velocities alone, beside the figures that are public.

``--play`` prints them side by side. It takes the extra ``pybullet``.
"""

from pathlib import Path
from typing import Any

from rmc.analysis.history import objects
from rmc.deploy.run.folder import RunFolder
from rmc.sweep.job import Job
from studies.study import Play, Scale, Study

PUBLISHED_STEPS = 1_500_000
PUBLISHED = {  # returns of RESeL (Luo et al., 2024), and of the best before it
    "pybullet/AntPositions-v0": (3045, 2597),
    "pybullet/AntVelocities-v0": (1779, 1137),
    "pybullet/HalfCheetahPositions-v0": (3632, 2802),
    "pybullet/HalfCheetahVelocities-v0": (2425, 2073),
}
STUDY = Study(
    "pybullet",
    {"RMC": "train ENV"},
    small=Scale(500_000, (1,), tuple(PUBLISHED)),
    full=Scale(PUBLISHED_STEPS, (1, 2, 3), tuple(PUBLISHED)),
)


def play(job: Job) -> dict[str, Any]:
    """A line: how a run's last policy played at its end."""
    result = RunFolder(job.folder).result()
    assert result is not None  # it has ended
    names = ("env_steps", "eval_return_mean", "eval_return_std")
    return {**job.values, "seed": job.seed} | {name: result[name] for name in names}


def report(path: Path) -> None:
    """A table, ours beside what is public."""
    print(f"| environment | seed | steps | return | RESeL, {PUBLISHED_STEPS:,} steps | best before it |")
    print("|---|---|---|---|---|---|")
    for line in objects(path, "env", "seed", "env_steps", "eval_return_mean", "eval_return_std").values():
        public = PUBLISHED.get(line["env"])
        resel, before = ("–", "–") if public is None else (f"{score:,}" for score in public)
        ours = f"{line['eval_return_mean']:,.0f} ± {line['eval_return_std']:,.0f}"
        print(f"| {line['env']} | {line['seed']} | {line['env_steps']:,} | {ours} | {resel} | {before} |")


if __name__ == "__main__":
    STUDY.main(Play("table", play, report))
