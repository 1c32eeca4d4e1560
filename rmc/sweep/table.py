"""How a sweep's runs did, by their values, best first."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from rmc.sweep.index import Index
from rmc.sweep.job import Job, shown


def result_table(jobs: Sequence[Job], index: Index) -> Table:
    """A row for each point of the grid or trial; the return is over finished runs alone."""
    points: dict[str, list[Job]] = {}
    for job in jobs:
        points.setdefault(repr(job.values), []).append(job)
    rows = [_row(runs, index) for runs in points.values()]
    rows.sort(key=lambda row: -row[0])
    table = Table(box=None, pad_edge=False)
    for name in [*jobs[0].values, "seeds", "return", "not finished"]:
        table.add_column(name, justify="right" if name in ("seeds", "return") else "left", no_wrap=True)
    for _, cells in rows:
        table.add_row(*cells)
    return table


def _row(runs: list[Job], index: Index) -> tuple[float, list[str]]:
    """Its mean return, by which it is sorted, and its cells."""
    returns = [line["return"] for job in runs if (line := index.lines.get(job.name)) and line["state"] == "finished"]
    mean = float(np.mean(returns)) if returns else -np.inf
    text = f"{mean:,.1f} ± {np.std(returns):,.1f}" if returns else "-"
    others = [index.state(job) for job in runs if index.state(job) != "finished"]
    counts = ", ".join(f"{others.count(state)} {state}" for state in dict.fromkeys(others))
    values: dict[str, Any] = runs[0].values
    return mean, [*map(shown, values.values()), str(len(returns)), text, counts]


def run_line(job: Job, index: Index) -> str:
    """How one run ended, for a line."""
    line = index.lines[job.name]
    returned = "" if line["return"] is None else f"return {line['return']:,.1f} after {line['env_steps']:,} steps, "
    said = "" if line["state"] == "finished" else f"{line['state']}: "
    reason = f"; {line['reason']}" if line["reason"] else ""
    return f"{job.title}: {said}{returned}{line['seconds']:,.0f} s{reason}"
