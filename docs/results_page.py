"""Puts the returns that ``results.toml`` names into results.md and README.md, and draws returns.png.

``make results-page``; a test sees to the tables. Published figures are means of 10 seeds on ``-v4``, from SimbaV2's
results/baseline/sac.csv.
"""

import re
import statistics
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

from rmc.analysis import history
from rmc.analysis.history import Evaluation, History

HERE = Path(__file__).parent
LINES = HERE.parent / "studies" / "results"
README, RESULTS, PICTURE = HERE.parent / "README.md", HERE / "results.md", HERE / "returns.png"
BEGIN, END = "<!-- returns: begin -->\n", "<!-- returns: end -->"
HEAD = {
    RESULTS: "| environment | agent | steps | return | each seed | wall time, s | public SAC (`-v4`) |",
    README: "| agent | seeds | return | wall time |",
}
IN_README = {
    "`robust`": "RMC, preset `robust`",
    "SAC": "SAC of stable-baselines3, heads of 400 and 300 units",
}


@dataclass(frozen=True)
class Row:
    """A line of the table: runs that count together, at some environment steps."""

    env: str
    agent: str
    steps: int
    runs: tuple[History, ...]
    public: int | None = None  # SAC's return there
    beside: bool = False  # another run or tests, so that it took longer

    @classmethod
    def of(cls, raw: dict[str, Any]) -> "Row":
        """Raises KeyError where a seed has no line."""
        runs: list[History] = []
        for file, agent, seeds in raw["runs"]:
            by_seed = {one.seed: one for one in _lines(file) if (one.env, one.agent) == (raw["env"], agent)}
            runs += [by_seed[seed] for seed in seeds]
        return cls(**raw | {"runs": tuple(runs)})

    def evaluations(self) -> list[Evaluation]:
        """Each run's, nearest to those steps."""
        return [min(run.evaluations, key=lambda one: abs(one.env_steps - self.steps)) for run in self.runs]

    def seeds(self) -> int:
        """How many there are, one that ran twice counted once."""
        return len({run.seed for run in self.runs})

    def mean(self) -> float:
        """Over runs."""
        return statistics.mean(one.return_mean for one in self.evaluations())


@cache
def _lines(file: str) -> list[History]:
    return history.read_histories(LINES / f"{file}.jsonl")


@cache
def rows(table: str) -> list[Row]:
    """Of a table, in its order."""
    return [Row.of(raw) for raw in tomllib.loads((HERE / "results.toml").read_text())[table]]


def page(path: Path) -> str:
    """The page with its table as it should be."""
    before, _, rest = path.read_text().partition(BEGIN)
    body = {RESULTS: _results, README: _readme}[path]()
    table = "\n".join([HEAD[path], "|---" * (HEAD[path].count("|") - 1) + "|", *body])
    return f"{before}{BEGIN}{table}\n{END}{rest.partition(END)[2]}"


def _results() -> Iterator[str]:
    for env, own in groupby(rows("returns"), key=lambda row: row.env):
        for number, row in enumerate(own):
            each = ", ".join(_number(one.return_mean) for one in row.evaluations())
            cells = [env if number == 0 else "", row.agent, _number(row.steps), _return(row), each, _seconds(row)]
            yield re.sub(r" +\|", " |", f"| {' | '.join(cells)} | {_number(row.public)} |")


def _readme() -> Iterator[str]:
    long = [row for row in rows("returns") if (row.env, row.steps) == ("HalfCheetah-v5", 300_000)]
    for row in long:
        if row.agent in IN_README:
            minutes = [round(one.wall_s / 60) for one in row.evaluations()]
            span = " to ".join(dict.fromkeys((str(min(minutes)), str(max(minutes)))))
            time = f"{span} minutes" + (", beside other work" if row.beside else "")
            yield f"| {IN_README[row.agent]} | {len(row.runs)} | {_return(row)} | {time} |"
    public = next(row.public for row in long if row.public is not None)
    yield f"| public SAC on HalfCheetah-v4 | 10 | {_number(public)} | – |"


def _return(row: Row) -> str:
    """Its mean, and deviation over runs; bold where it is ahead of another agent of two seeds or more."""
    if len(row.runs) == 1:
        return _number(row.mean())
    deviation = statistics.stdev(one.return_mean for one in row.evaluations())
    beside = [one for one in rows("returns") if (one.env, one.steps) == (row.env, row.steps) and one.seeds() > 1]
    text = f"{_number(row.mean())} ± {_number(deviation)}"
    return f"**{text}**" if len(beside) > 1 and row is max(beside, key=Row.mean) else text


def _seconds(row: Row) -> str:
    seconds = [one.wall_s for one in row.evaluations()]
    span = " to ".join(dict.fromkeys((_number(min(seconds)), _number(max(seconds)))))
    return span + "*" * row.beside


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:,.0f}".replace(",", " ").replace("-", "\u2212")


def draw() -> None:
    """A panel an environment, two rows of them, a line a seed; published figures are crosses."""
    from matplotlib.figure import Figure

    long = [row for table in ("returns", "half_missing") for row in rows(table) if row.steps >= 300_000]
    panels = {env: list(own) for env, own in groupby(long, key=lambda row: row.env)}
    columns = -(-len(panels) // 2)
    figure = Figure(figsize=(2.9 * columns, 5.6), layout="constrained")
    places = [figure.add_subplot(2, columns, 1 + place) for place in range(len(panels))]
    handles: dict[str, Any] = {}
    for axes, (env, own) in zip(places, panels.items(), strict=True):
        for row in own:
            _draw_row(axes, row, handles)
        marks = [(row.steps, row.public) for row in rows("returns") if row.env == env and row.public is not None]
        if marks:
            (handles["public SAC, on -v4"],) = axes.plot(*zip(*marks, strict=True), "x", color="black", markersize=8)
        axes.set(title=env.replace(", ", "\n"))
        axes.locator_params(axis="x", nbins=4)
        axes.grid(alpha=0.3)
    figure.supxlabel("environment steps")
    figure.supylabel("return")
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=5, frameon=False)
    figure.savefig(PICTURE, dpi=110)


def _draw_row(axes: Any, row: Row, handles: dict[str, Any]) -> None:
    name = row.agent.split(",")[0].replace("`", "")
    colour = handles[name].get_color() if name in handles else f"C{len(handles)}"
    for run in row.runs:
        points = [(one.env_steps, one.return_mean) for one in run.evaluations]
        (handles[name],) = axes.plot(*zip(*points, strict=True), color=colour, linewidth=1.2, alpha=0.8)


def main() -> None:
    for path in HEAD:
        path.write_text(page(path))
    draw()


if __name__ == "__main__":
    main()
