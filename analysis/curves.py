"""``rmc plot``: returns of many runs as curves and as a table, by agent and environment.

From five seeds on, the interquartile mean and its bootstrap interval; with fewer, every seed is a line of its own.
Runs of other length, unfinished ones, and further runs of the same seed are an agent of their own.
"""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from rmc.analysis.history import History
from rmc.analysis.statistics import ENOUGH_SEEDS, Scores, interquartile_mean, interval, probability_of_improvement
from rmc.common.errors import ConfigError
from rmc.common.extra import check_installed
from rmc.common.return_text import return_text

Axis = Literal["env_steps", "updates", "wall_s"]
LABELS = {"env_steps": "agent steps", "updates": "updates", "wall_s": "wall time (s)"}
LEGEND_WIDTH, LEGEND_LINE = 55, 0.22  # characters under a panel, inches
SAME_LENGTH = 1.05  # runs overshoot their end a little
POINTS, CURVE_RESAMPLES, COLUMNS, LAST = 100, 300, 3, 5
WIDTH, AGENT_WIDTH = 1_000, 60  # of the table, as a cut return is none, and of a name until it goes on below
DASHES = ("-", "--", ":", "-.")
HEADINGS = ("agent", "seeds", "return", f"worst of last {LAST}", "steps", "updates", "wall s")
Groups = dict[str, dict[str, list[History]]]  # environment -> agent -> its runs
Line = tuple[NDArray[np.float64], NDArray[np.float64]]  # places, and returns there


def grouped(histories: Sequence[History]) -> Groups:
    """By environment, then agent, each in the order in which it came; seeds in order. A run given twice counts once."""
    alike: Groups = {}
    for one in histories:
        runs = alike.setdefault(one.env, {}).setdefault(one.agent, [])
        if one not in runs:
            runs.append(one)
    return {
        env: {name: runs for agent, all_runs in agents.items() for name, runs in _comparable(agent, all_runs).items()}
        for env, agents in alike.items()
    }


def _comparable(agent: str, runs: list[History]) -> dict[str, list[History]]:
    """What may be averaged, by its name: finished or not, as long as each other, each seed once."""
    alike: dict[tuple[bool, int], list[History]] = {}
    for run in sorted(runs, key=lambda run: (not run.finished, run.env_steps)):
        key = next((key for key in alike if key[0] == run.finished and run.env_steps <= SAME_LENGTH * key[1]), None)
        alike.setdefault(key or (run.finished, run.env_steps), []).append(run)
    groups: dict[str, list[History]] = {}
    for (finished, steps), same in alike.items():
        state = "" if finished else ", unfinished"
        name = agent if len(alike) == 1 else f"{agent}{state}, {steps:,} steps"
        seeds: list[int] = []
        for run in sorted(same, key=lambda run: (run.seed, runs.index(run))):  # as they were given
            seeds.append(run.seed)
            again = f", run {seeds.count(run.seed)} of its seed" if seeds.count(run.seed) > 1 else ""
            groups.setdefault(name + again, []).append(run)
    return groups


def curve(run: History, by: Axis) -> Line:
    """Where it was evaluated, and the returns there; it starts with what it had before training."""
    places = [float(getattr(one, by)) for one in run.evaluations]
    returns = [one.return_mean for one in run.evaluations]
    if run.initial_return is not None:
        places, returns = [0.0, *places], [run.initial_return, *returns]
    return np.array(places), np.array(returns)


def draw(groups: Groups, by: Axis, out: Path) -> None:
    """A panel an environment, a colour an agent. Raises ConfigError where what draws is not installed."""
    check_installed("plot", ("matplotlib",), "--out", str(out))
    from matplotlib.figure import Figure  # an extra

    columns = min(COLUMNS, len(groups))
    rows = -(-len(groups) // columns)
    agents = list(dict.fromkeys(agent for runs in groups.values() for agent in runs))
    names = [textwrap.fill(_named(agent, groups, by), LEGEND_WIDTH) for agent in agents]
    legend = LEGEND_LINE * sum(name.count("\n") + 1 for name in names) / columns
    figure = Figure(figsize=(1.0 + 5.0 * columns, 0.6 + 3.3 * rows + legend), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    handles: dict[str, Any] = {}
    for panel, (env, by_agent) in zip(panels, groups.items(), strict=False):
        for agent, runs in by_agent.items():
            line = draw_agent(panel, [curve(run, by) for run in runs], agents.index(agent))
            handles.setdefault(agent, line)
        panel.set_title(env, parse_math=False)
        panel.set_xlabel(LABELS[by])
        panel.locator_params(axis="x", nbins=5)  # more would run into each other
        panel.set_ylabel("return")
        panel.grid(alpha=0.3)
    for panel in panels[len(groups) :]:
        panel.set_axis_off()
    shown = figure.legend(handles.values(), names, loc="outside lower center", ncols=columns)
    for text in shown.get_texts():
        text.set_parse_math(False)
    figure.savefig(out, dpi=110)


def draw_agent(panel: Any, curves: list[Line], index: int) -> Any:
    """Few runs as a line each, more as their mean and its interval where all have been; a line for the legend.

    ``index`` is the agent's among those of the figure: it has a colour, and from the eleventh on dashes.
    """
    style: Any = {"color": f"C{index % 10}", "linestyle": DASHES[index // 10 % len(DASHES)]}
    low, high = _shared(curves)
    if not _has_band(curves):
        style |= {"linewidth": 1.2, "alpha": 0.8}
        if max(len(x) for x, _ in curves) <= POINTS:  # in an SVG each marker is an element
            style |= {"marker": "o", "markersize": 2.5}
        lines = [panel.plot(*one, **style)[0] for one in curves]
        return lines[0]
    places = np.linspace(low, high, POINTS)
    returns = np.stack([np.interp(places, *one) for one in curves])  # (R, POINTS)
    line = panel.plot(places, [interquartile_mean(at) for at in returns.T], **style)[0]
    bands = [interval(at, CURVE_RESAMPLES) for at in returns.T]
    panel.fill_between(places, *np.transpose(bands), color=style["color"], alpha=0.2, linewidth=0)
    return line


def _shared(curves: list[Line]) -> tuple[float, float]:
    """Where all runs have been: from, to."""
    return max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)


def _has_band(curves: list[Line]) -> bool:
    low, high = _shared(curves)
    return len(curves) >= ENOUGH_SEEDS and low < high


def _named(agent: str, groups: Groups, by: Axis) -> str:
    drawn = [by_agent[agent] for by_agent in groups.values() if agent in by_agent]
    fewest, most = min(map(len, drawn)), max(map(len, drawn))
    banded = [_has_band([curve(run, by) for run in runs]) for runs in drawn]
    how = " or ".join(["each a line"] * (not all(banded)) + ["interquartile mean, 95 %"] * any(banded))
    seeds = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    return f"{agent} ({seeds} seed{'s' * (most > 1)}, {how})"


def last_returns(runs: list[History]) -> Scores:
    """(R,): of every run's last evaluation."""
    return np.array([run.evaluations[-1].return_mean for run in runs])


def tables(groups: Groups, reference: str | None) -> list[Table]:
    """One an environment, a line an agent; beside ``reference``, an agent, where there is one. Raises ConfigError."""
    agents = {agent for by_agent in groups.values() for agent in by_agent}
    if reference is not None and reference not in agents:
        raise ConfigError("--reference", reference, f"use one of {', '.join(map(repr, sorted(agents)))}")
    return [_table(env, by_agent, reference) for env, by_agent in groups.items()]


def _table(env: str, by_agent: dict[str, list[History]], reference: str | None) -> Table:
    table = Table(title=env, title_justify="left", box=None, pad_edge=False)
    for name in [*HEADINGS, *(["scaled", "P(better)"] if reference else [])]:
        if name == "agent":
            table.add_column(name, max_width=AGENT_WIDTH)
        else:
            table.add_column(name, justify="right", no_wrap=True)
    for agent, runs in by_agent.items():
        table.add_row(agent, *cells(runs), *(_beside(runs, by_agent.get(reference, [])) if reference else []))
    return table


def cells(runs: list[History]) -> list[str]:
    """An agent's, under the ``HEADINGS`` after its name."""
    seeds, unfinished = str(len(runs)), sum(not run.finished for run in runs)
    seeds += f", {unfinished} unfinished" if unfinished else ""
    ends = [run.env_steps for run in runs]
    steps = f"{min(ends):,}" + (f" to {max(ends):,}" if min(ends) < max(ends) else "")
    counts = [np.median([getattr(run, name) for run in runs]) for name in ("updates", "wall_s")]
    worst = min(one.return_mean for run in runs for one in run.evaluations[-LAST:])
    return [seeds, _returns(runs), return_text(worst), steps, *(f"{count:,.0f}" for count in counts)]


def _returns(runs: list[History]) -> str:
    scores = last_returns(runs)
    if len(runs) >= ENOUGH_SEEDS:
        low, high = interval(scores)
        return f"{return_text(_centre(scores))} [{return_text(low)}, {return_text(high)}]"
    return f"{return_text(_centre(scores))} ({', '.join(map(return_text, scores))})"


def _centre(scores: Scores) -> float:
    """(R,) -> the return that is shown of R runs."""
    return interquartile_mean(scores) if len(scores) >= ENOUGH_SEEDS else float(scores.mean())


def _beside(runs: list[History], reference: list[History]) -> list[str]:
    """The return that is shown, scaled: the reference's is 1, an untrained agent's 0; the chance to beat it."""
    initial = [run.initial_return for run in reference if run.initial_return is not None]
    if not reference:
        return ["", ""]
    scores, others = last_returns(runs), last_returns(reference)
    low, high = (np.mean(initial) if initial else np.nan), _centre(others)
    share = f"{(_centre(scores) - low) / (high - low):.2f}" if initial and high != low else ""
    return [share, f"{probability_of_improvement(scores, others):.2f}"]
