"""``rmc report``: one HTML file about runs, which a browser shows without a network."""

import time
from collections.abc import Sequence
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

from rmc.analysis.curves import HEADINGS, cells, grouped
from rmc.analysis.history import History
from rmc.analysis.out_file import check_writable
from rmc.analysis.report_run import ReportRun
from rmc.common.extra import check_installed
from rmc.common.whole_file import write_whole
from rmc.deploy.run.option_names import option
from rmc.deploy.run.starts import format_starts

PAGES = (".html", ".htm")
CHARTS = (  # what is drawn over wall time: its name, its unit, and its lines by role and metric
    ("throughput of agent steps", "steps / s", {"collected": ("replay", "env_steps_per_s")}),
    ("throughput of updates", "updates / s", {"learner": ("learner", "updates_per_s")}),
    (
        "staleness of policies", "updates behind",
        {"when inserted": ("replay", "policy_lag_mean"), "when trained on": ("learner", "sample_age_mean")},
    ),
    (
        "staleness of replayed memories", "distance / norm",
        {"as stored": ("learner", "stale_state_stored"), "after burn-in": ("learner", "stale_state_burned")},
    ),
)  # fmt: skip


def check_report(out: Path) -> None:
    """Raises ConfigError where a report cannot be made, or not there."""
    check_installed("report", ("matplotlib", "jinja2"), "--out", str(out))
    check_writable("--out", out, PAGES)


def write_report(runs: Sequence[ReportRun], out: Path, with_video: bool) -> None:
    """The whole page. ``check_report`` must have been called."""
    from jinja2 import Environment  # an extra

    from rmc.analysis import report_media  # imports torch

    shown = [report_media.media(run, with_video) for run in newest(runs)]
    page = {
        "title": f"Report of {runs[0].name}" if len(runs) == 1 else f"Report of {len(runs)} runs",
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "version": version("rmc-rl"),
        "runs": runs,
        "returns": _returns([run.history for run in runs if run.history is not None]),
        "final_columns": HEADINGS,
        "unevaluated": [run.name for run in runs if run.history is None],
        "films": [film for film, _ in shown if film is not None],
        "rollouts": [rollouts for _, rollouts in shown],
        "courses": [_course(run) for run in runs],
        "differences": differences(runs),
    }
    template = files("rmc.analysis").joinpath("report.html").read_text(encoding="utf-8")
    page_template = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(template)
    write_whole(out, page_template.render(page).encode(errors="replace"))  # of a folder's name that is no UTF-8


def newest(runs: Sequence[ReportRun]) -> list[ReportRun]:
    """Of every agent in every environment the run that was trained last: its policy is played."""
    last: dict[tuple[str, str], ReportRun] = {}
    for run in sorted(runs, key=lambda run: run.records[-1]["time"] if run.records else 0.0):
        last[run.about.env, run.about.agent] = run
    return [run for run in runs if run in last.values()]


def _returns(histories: list[History]) -> list[dict[str, Any]]:
    from rmc.analysis.report_figures import COLOURS, returns

    rows = []
    for env, agents in grouped(histories).items():
        colours = {agent: COLOURS[i % len(COLOURS)] for i, agent in enumerate(agents)}
        rows.append(
            {
                "name": env,
                "colours": colours,
                "over_steps": returns(agents, "env_steps"),
                "over_wall": returns(agents, "wall_s"),
                "final": [[agent, *cells(past)] for agent, past in agents.items()],
            }
        )
    return rows


def _course(run: ReportRun) -> dict[str, Any]:
    """How a run went, in figures over wall time."""
    from rmc.analysis.report_figures import over_time, waits

    drawn = {
        title: over_time({name: run.series(*metric) for name, metric in lines.items()}, unit)
        for title, unit, lines in CHARTS
    }
    figures = [{"alt": title, "uri": uri} for title, uri in drawn.items() if uri]
    baseline = run.folder.is_baseline()
    return {
        "name": run.name,
        "is_baseline": baseline,
        "starts": format_starts(run.folder),
        "findings": run.findings,
        "waits": waits(run),
        "figures": figures,
    }


def differences(runs: Sequence[ReportRun]) -> dict[str, Any]:
    """Options that are not alike in the runs that have them; of one run, those that are not its preset's."""
    if len(runs) == 1 and runs[0].folder.is_baseline():
        options = [[name, words(value)] for name, value in _by_name(runs[0]).items()]
        return {"columns": [runs[0].name], "rows": options, "note": "Options. A baseline has no preset."}
    if len(runs) == 1:
        changed = runs[0].changed()
        rows = [[option(path), *map(words, values)] for path, values in changed.items()]
        note = "Options that are not the preset's." if rows else "All options are the preset's."
        return {"columns": ["preset", runs[0].name], "rows": rows, "note": note}
    columns = [_by_name(run) for run in runs]
    rows = []
    for name in dict.fromkeys(name for column in columns for name in column):
        values = [column[name] for column in columns if name in column]
        if any(value != values[0] for value in values):
            rows.append([name, *(words(column[name]) if name in column else "-" for column in columns)])
    note = "Options that are not alike in all runs that have them." if rows else "All options are alike."
    return {"columns": [run.name for run in runs], "rows": rows, "note": note}


def _by_name(run: ReportRun) -> dict[str, Any]:
    """Its options; a baseline's lie at other paths of its config than a run's."""
    return {option(path): value for path, value in run.options.items()}


def words(value: Any) -> str:
    """An option's value, as pages show it."""
    if value in (None, {}, (), []):
        return "none"
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, list | tuple):
        return " ".join(map(words, value))
    return f"{value:,}".replace(",", " ") if isinstance(value, int) else str(value)
