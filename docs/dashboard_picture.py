"""Draws the dashboard's panels from a Prometheus: ``python -m docs.dashboard_picture http://127.0.0.1:9090 SECONDS``.

For the docs alone, and without Grafana: the queries, titles and places are dashboard.json's. SECONDS: how far back.
"""

import json
import re
import sys
import time
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.axes import Axes

HERE = Path(__file__).parent
DASHBOARD, PICTURE = HERE.parent / "deploy" / "monitor" / "dashboard.json", HERE / "dashboard.png"
STEP_SECONDS, COLUMNS, LONGEST_LEGEND = 2.0, 24, 8
Points = list[tuple[float, str]]  # seconds since the epoch, and a value


def ask(prometheus: str, path: str, **words: Any) -> Any:
    """What its API answers."""
    with urllib.request.urlopen(f"{prometheus}/api/v1/{path}?{urllib.parse.urlencode(words)}") as answer:
        return json.load(answer)["data"]


def series(prometheus: str, target: dict[str, str], instance: str, seconds: float) -> list[dict[str, Any]]:
    """The lines of a panel's target."""
    end, expr = time.time(), target["expr"].replace("$instance", instance)
    words = {"query": expr, "start": end - seconds, "end": end, "step": STEP_SECONDS}
    found: list[dict[str, Any]] = ask(prometheus, "query_range", **words)["result"]
    return found


def label(target: dict[str, str], metric: dict[str, str]) -> str:
    """As its legendFormat says."""
    return re.sub(r"{{(\w+)}}", lambda found: metric.get(found[1], ""), target["legendFormat"])


def draw(axes: Axes, panel: dict[str, Any], lines: list[tuple[str, Points]]) -> None:
    """A number, or lines over the minutes."""
    axes.set_title(panel["title"], fontsize=9, loc="left")
    if panel["type"] == "stat":
        value = float(lines[0][1][-1][1])
        text = f"{value:.1%}" if panel["fieldConfig"]["defaults"]["unit"] == "percentunit" else f"{value:,.0f}"
        axes.text(0.5, 0.45, text, fontsize=20, ha="center", va="center")
        axes.set(xticks=[], yticks=[])
        return
    for name, points in lines:
        minutes = [(at - time.time()) / 60 for at, _ in points]
        axes.plot(minutes, [float(value) for _, value in points], label=name, linewidth=1)
    axes.tick_params(labelsize=7)
    if 0 < len(lines) <= LONGEST_LEGEND:
        axes.legend(fontsize=6, loc="best")


def main(prometheus: str, seconds: float) -> None:
    """All panels, each where Grafana has it."""
    panels = json.loads(DASHBOARD.read_text())["panels"]
    instance = ask(prometheus, "query", query="rmc_run_info")["result"][0]["metric"]["instance"]
    rows = max(panel["gridPos"]["y"] + panel["gridPos"]["h"] for panel in panels)
    figure = plt.figure(figsize=(14, 0.42 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, COLUMNS)
    for panel in panels:
        x, y, width, height = (panel["gridPos"][key] for key in ("x", "y", "w", "h"))
        axes = figure.add_subplot(grid[y : y + height, x : x + width])
        found = [(target, one) for target in panel["targets"] for one in series(prometheus, target, instance, seconds)]
        draw(axes, panel, [(label(target, one["metric"]), one["values"]) for target, one in found])
    figure.supxlabel("minutes", fontsize=8)
    figure.savefig(PICTURE, dpi=80)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
