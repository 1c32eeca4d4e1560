"""The figures of a report, each as SVG in a data URI: curves with bands, throughput, staleness, and who waited."""

import base64
import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from rmc.analysis.curves import LABELS, Axis, curve, draw_agent
from rmc.analysis.history import History
from rmc.analysis.report_run import ReportRun, Series
from rmc.analysis.vitals import Vitals

SIZE, WIDE = (5.2, 3.1), (10.6, 4.4)  # inches
POINTS = 120  # of a line over time, means of what lies between
STRETCHES, STRETCH_SECONDS = 100, 2.0  # most of a strip, and the shortest: in it every role has spoken
BUSY, OTHER = "#2a9d8f", "#8d8d8d"
REASONS = {  # what roles wait for, in the same colour in every report
    "credit": "#8ab6d6", "experience": "#e76f51", "windows": "#f2a488", "draws": "#c5dcea", "weights": "#e9c46a",
    "acknowledgements": "#c97b9d", "a policy to evaluate": "#e3e0ee", "redis": "#b00020", "disk": "#7a6fac",
}  # fmt: skip
STYLE: Any = {
    "font.size": 9.0, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.25,
    "axes.axisbelow": True, "legend.frameon": False, "svg.hashsalt": "rmc",
}  # fmt: skip
COLOURS = tuple(to_hex(f"C{i}") for i in range(10))
HOUR, MINUTES = 3600.0, 600.0  # of seconds: from so many on, an axis has hours or minutes


def data_uri(content: bytes, kind: str) -> str:
    """What an ``src`` takes in place of a file."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _drawn(figure: Figure) -> str:
    file = io.BytesIO()
    figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return data_uri(file.getvalue(), "image/svg+xml")


def returns(agents: dict[str, list[History]], by: Axis) -> str:
    """Evaluation returns of one environment's agents, drawn as ``rmc plot`` does."""
    with rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        panel = figure.subplots()
        scale, unit = (
            _time_unit([one.wall_s for runs in agents.values() for one in runs]) if by == "wall_s" else (1, "")
        )
        for index, runs in enumerate(agents.values()):
            lines = [(places / scale, values) for places, values in (curve(run, by) for run in runs)]
            draw_agent(panel, lines, index)
        panel.set_xlabel(f"wall time ({unit})" if unit else LABELS[by])
        panel.set_ylabel("evaluation return")
        panel.locator_params(axis="x", nbins=6, integer=by == "env_steps")
        if by == "env_steps":
            panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        return _drawn(figure)


def _time_unit(seconds: Sequence[float]) -> tuple[float, str]:
    longest = max(seconds, default=0.0)
    return (HOUR, "h") if longest >= HOUR else (60.0, "min") if longest >= MINUTES else (1.0, "s")


def over_time(lines: dict[str, Series], label: str) -> str | None:
    """Metrics over wall time, in bins; None where none was recorded."""
    recorded = {name: series for name, series in lines.items() if series[0]}
    if not recorded:
        return None
    scale, unit = _time_unit([seconds for places, _ in recorded.values() for seconds in places])
    with rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        panel = figure.subplots()
        for (name, series), colour in zip(recorded.items(), COLOURS, strict=False):
            places, values = _binned(*series)
            marker = "o" if len(values) == 1 else ""  # a line of one point is none
            panel.plot(places / scale, values, color=colour, linewidth=1.4, marker=marker, label=name)
        panel.set_xlabel(f"wall time ({unit})")
        panel.set_ylabel(label)
        panel.set_ylim(bottom=0.0)
        panel.legend(fontsize=8, loc="best")
        return _drawn(figure)


def _binned(places: list[float], values: list[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means of at most ``POINTS`` stretches of equal length that hold any."""
    x, y = np.array(places), np.array(values)
    bins = _bins(x, POINTS)
    counts = np.bincount(bins, minlength=POINTS)
    held = counts > 0
    sums = (np.bincount(bins, one, POINTS)[held] for one in (x, y))
    mean_x, mean_y = (total / counts[held] for total in sums)
    return mean_x, mean_y


def _bins(x: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """In which of so many stretches of equal length each lies."""
    width = (x.max() - x.min()) / count or 1.0
    bins: NDArray[np.int64] = np.minimum(((x - x.min()) / width).astype(np.int64), count - 1)
    return bins


def waits(run: ReportRun) -> str | None:
    """Who worked and who waited for what over wall time, a strip for each kind of role."""
    walls = np.array([record["trained_s"] for record in run.records])
    if not len(walls):
        return None
    longest = float(walls.max() - walls.min())
    bins = _bins(walls, max(1, min(STRETCHES, int(longest / STRETCH_SECONDS))))
    stretches = [
        (float(walls[bins == at].mean()), Vitals([run.records[i] for i in np.flatnonzero(bins == at)], math.inf))
        for at in np.unique(bins)
    ]
    kinds = [
        kind
        for kind in ("learner", "actor", "replay", "evaluator")
        if any(v.busy(kind) is not None for _, v in stretches)
    ]
    reasons = list(dict.fromkeys(reason for _, v in stretches for kind in kinds for reason in v.waits(kind)))
    return _strips(stretches, kinds, [reason for reason in reasons if reason]) if kinds else None


def _strips(stretches: list[tuple[float, Vitals]], kinds: list[str], reasons: list[str]) -> str:
    scale, unit = _time_unit([wall for wall, _ in stretches])
    colours = {reason: REASONS.get(reason, OTHER) for reason in reasons}
    handles: dict[str, Any] = {}
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDE[0], 0.9 + 0.85 * len(kinds)), layout="constrained")
        panels = figure.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0]
        for panel, kind in zip(panels, kinds, strict=True):
            recorded = [(wall / scale, v) for wall, v in stretches if v.busy(kind) is not None]
            shares = [
                [v.busy(kind) or 0.0 for _, v in recorded],
                *([v.waits(kind).get(r, 0.0) for _, v in recorded] for r in reasons),
            ]
            areas = panel.stackplot(
                [wall for wall, _ in recorded], *shares, colors=[BUSY, *colours.values()], linewidth=0, step="mid"
            )
            handles |= {
                name: area
                for name, area, share in zip(["busy", *reasons], areas, shares, strict=True)
                if max(share) > 0.01
            }
            panel.set_ylim(0.0, 1.0)
            panel.set_yticks([0.0, 1.0], ["0", "100 %"])
            panel.set_ylabel({"actor": "actors"}.get(kind, kind), rotation=0, ha="right", va="center")
            panel.grid(visible=False)
        panels[-1].set_xlabel(f"wall time ({unit})")
        names = [name if name == "busy" else f"waits for {name}" for name in handles]
        shown = figure.legend(handles.values(), names, loc="outside upper center", ncols=min(4, len(names)), fontsize=8)
        for text in shown.get_texts():  # a role's own words
            text.set_parse_math(False)
        return _drawn(figure)
