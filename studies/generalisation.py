"""Generalisation (a) of the paper: trained where everything is seen, played with more and more frames blank.

After the runs, the same command with ``--play`` plays each with p = 0 … 1 and tells the areas;
``--draw PICTURE FILE …`` draws the lines of such files, a panel an environment.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from rmc.analysis.history import objects
from rmc.analysis.out_file import PICTURES, check_writable
from rmc.analysis.run_evaluation import evaluate_run
from rmc.analysis.statistics import ENOUGH_SEEDS, interquartile_mean, interval
from rmc.common.errors import ConfigError
from rmc.sweep.job import Job
from studies.study import Play, Scale, Study, before

ENVS = ("HalfCheetah-v5", "Walker2d-v5", "Ant-v5")
PROBABILITIES = tuple(round(0.1 * tenths, 1) for tenths in range(11))
AREA = slice(1, 10)  # p = 0.1 … 0.9
EPISODES = 10
STUDY = Study(
    "generalisation",
    {
        "RMC": "train ENV",
        "RMC, target critics": before(),
        "RMC, not averaged": before("--policy-ema-updates 0"),
        "RMC, clipped": before("--clip-norm 40 --policy-ema-updates 0"),
        "RMC, scheme 1": before("--scheme 1 --clip-norm 40 --policy-ema-updates 0"),
        "SAC": "baseline sac ENV",
    },
    small=Scale(100_000, (1, 2, 3)),
    full=Scale(1_000_000, (1, 2, 3, 4, 5), ENVS),
)


def play(job: Job, episodes: int = EPISODES) -> dict[str, object]:
    """A line: returns of a run's last checkpoint under each probability."""
    played = [evaluate_run(job.folder, episodes, flicker=probability) for probability in PROBABILITIES]
    about = {**job.values, "seed": job.seed, "env_steps": played[-1]["env_steps"]}
    return about | {"flicker": PROBABILITIES, "returns": [one["eval_return_mean"] for one in played]}


def area(returns: list[float]) -> float:
    """Mean return over p = 0.1 … 0.9."""
    return float(np.mean(returns[AREA]))


def report(path: Path) -> None:
    """The areas by environment and agent, with an interval where there are seeds enough."""
    by_agent: dict[tuple[str, str], list[float]] = {}
    for line in objects(path, "agent", "env", "returns").values():
        by_agent.setdefault((line["env"], line["agent"]), []).append(area(line["returns"]))
    for (env, agent), areas in by_agent.items():
        scores = np.array(areas)
        text = f"{env}, {agent}: {scores.mean():,.0f} ({', '.join(f'{one:,.0f}' for one in areas)})"
        if len(areas) >= ENOUGH_SEEDS:
            low, high = interval(scores)
            text += f"; interquartile mean {interquartile_mean(scores):,.0f} [{low:,.0f}, {high:,.0f}]"
        print(text)


def draw(out: Path, paths: list[Path]) -> None:
    """Returns over p: a panel an environment, a line a run."""
    from matplotlib.figure import Figure  # an extra

    check_writable("--draw", out, PICTURES)
    names = "agent", "env", "seed", "env_steps", "flicker", "returns"
    lines = [line for path in paths for line in objects(path, *names).values()]
    envs = list(dict.fromkeys(line["env"] for line in lines))
    figure = Figure(figsize=(6.0 * len(envs), 4.2), layout="constrained")
    for panel, env in zip(figure.subplots(1, len(envs), squeeze=False).flat, envs, strict=True):
        for line in lines:
            if line["env"] == env:
                name = f"{line['agent']}, seed {line['seed']}, {line['env_steps']:,} steps"
                panel.plot(line["flicker"], line["returns"], marker="o", markersize=3, label=name)
        panel.set(title=env, xlabel="probability that a frame is blank", ylabel="return")
        panel.grid(alpha=0.3)
        panel.legend(fontsize="small")
    figure.savefig(out, dpi=110)


def main() -> None:
    """Train, or play what was trained, or draw how it played."""
    if "--draw" not in sys.argv:
        STUDY.main(Play("flicker", play, report))
        return
    parser = argparse.ArgumentParser()
    parser.add_argument("--draw", type=Path, nargs="+", metavar=("PICTURE", "FILE"))
    out, *paths = parser.parse_args().draw
    if not paths:
        parser.error(f"--draw={out}: name the files of lines after the picture")
    try:
        draw(out, paths)
    except ConfigError as error:
        sys.exit(f"studies.{STUDY.name}: {error}")


if __name__ == "__main__":
    main()
