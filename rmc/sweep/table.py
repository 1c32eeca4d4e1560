"""How a sweep's runs did, by environment and values, best first."""

from collections.abc import Sequence

import numpy as np
from rich.table import Table

from rmc.common.return_text import return_text
from rmc.deploy.monitor.table import plain_table
from rmc.sweep.index import Index
from rmc.sweep.job import TRIAL, Job, value_text


def result_table(jobs: Sequence[Job], index: Index) -> Table:
    """A row for each point of the grid, or each trial; the return is over finished runs alone."""
    points: dict[str, list[Job]] = {}
    for job in jobs:
        points.setdefault(job.name if job.is_trial else repr(job.values), []).append(job)
    names = list(jobs[0].values)
    by_env: dict[str, list[tuple[float, list[str]]]] = {}
    for runs in points.values():
        by_env.setdefault(runs[0].values.get("env", ""), []).append(_row(runs, index, names))
    rows = [row for each in by_env.values() for row in sorted(each, key=lambda row: -row[0])]
    whole = all(not cells[-1] for _, cells in rows)
    columns = ["trial" if jobs[0].is_trial else "", *names, "seeds", "return", "not finished"]
    shown_at = [at for at, name in enumerate(columns) if name and not (whole and name == "not finished")]
    table = plain_table([columns[at] for at in shown_at], columns)
    for _, cells in rows:
        table.add_row(*(cells[at] for at in shown_at))
    return table


def _row(runs: list[Job], index: Index, names: list[str]) -> tuple[float, list[str]]:
    """Its mean return, by which it is sorted, and its cells."""
    finished = [index.lines[job.name] for job in runs if index.state(job) == "finished"]
    returns = [line["return"] for line in finished if line["return"] is not None]
    mean = float(np.mean(returns)) if returns else -np.inf
    deviation = float(np.std(returns, ddof=1)) if len(returns) > 1 else None
    others = [index.state(job) for job in runs if index.state(job) != "finished"]
    counts = ", ".join(f"{others.count(state)} {state}" for state in dict.fromkeys(others))
    is_trial = runs[0].is_trial  # whose values were drawn, with all their digits
    drawn = (runs[0].values[name] for name in names)  # trials of another command may have another order
    values = (f"{one:.4g}" if is_trial and isinstance(one, float) else value_text(one) for one in drawn)
    text = return_text(mean, deviation) if returns else "-"
    return mean, [runs[0].name.removeprefix(TRIAL), *values, str(len(returns)), text, counts]


def run_line(job: Job, index: Index) -> str:
    """How one run ended, for a line."""
    line = index.lines[job.name]
    returned = ""
    if line["return"] is not None:
        returned = f"return {return_text(line['return'])} after {line['env_steps']:,} steps, "
    state = "" if line["state"] == "finished" else f"{line['state']}: "
    reason = f"; {line['reason']}" if line["reason"] else ""
    return f"{job.title}: {state}{returned}{line['seconds']:,.0f} s{reason}"
