"""The state of a run as a table that fits a terminal: where there is little room, what matters comes first."""

import re
import textwrap
from collections.abc import Collection, Iterable
from statistics import mean
from typing import Any

from rich.console import Group, RenderableType
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rmc.common.return_text import return_text
from rmc.deploy.monitor.figures import known_return, number, time_and_eta
from rmc.deploy.monitor.notices import count, notices, waits
from rmc.deploy.monitor.run_status import EvaluationStatus, RunStatus

SIDE_WIDTH = 120  # from which the roles stand beside the figures
LABEL = 13  # columns of a figure's name
BAR = 60  # most columns of the bar
STYLES = {
    "finished": "green", "training": "cyan", "stopped": "yellow", "failed": "red", "lost": "red",
    "new": "", "unknown": "",
}  # fmt: skip
Fact = tuple[str, str]  # a figure's name and its text


def plain_table(headings: Iterable[str], right: Collection[str] = ()) -> Table:
    """One without lines or rows; the columns that ``right`` names stand at the right, each of their cells in a line."""
    drawn = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for name in headings:
        drawn.add_column(name, justify="right" if name in right else "left", no_wrap=name in right, overflow="fold")
    return drawn


def table(status: RunStatus, width: int, height: int | None = None) -> RenderableType:
    """All of it, or with a ``height`` what fits into so many rows."""
    beside = width >= SIDE_WIDTH
    columns = width // 2 - 2 if beside else width
    warnings = notices(status)
    lines = [_title(status, columns), _bar(status, columns), *_lines(_essentials(status), columns)]
    lines += [row for fact in warnings.items() for row in _rows(*fact, columns, "yellow")]
    everyone, room = len(status.of_this_start()), (height or 10**6) - len(lines)
    if beside:
        whole = Table.grid(padding=(0, 4, 0, 0))
        whole.add_row(
            Group(*lines[:height], *_lines(_details(status), columns, room)), _roles(status, len(lines) + room - 1)
        )
        return whole
    least = min(everyone, len(_groups(status)))
    if room <= least:
        waiting = _rows("waiting", waits(status) or number(None), columns)
        return Group(*[*lines, *waiting][:height])
    details = _lines(_details(status), columns, room - least - 1)
    return Group(*lines, *details, _roles(status, room - len(details) - 1))


def _title(status: RunStatus, width: int) -> Text:
    rest = Text(f" · {status.preset} · seed {status.seed}")
    if status.state is not None:
        rest.append(" · ").append(status.state, STYLES[status.state])
    env = Text(status.env)
    env.truncate(max(8, width - rest.cell_len), overflow="ellipsis")
    return Text.assemble((env.plain, "bold"), rest)


def _bar(status: RunStatus, width: int) -> RenderableType:
    bar = Table.grid(padding=(0, 1, 0, 0))
    done = status.share_done
    bar.add_row(
        Text(f"{done:.1%}", "bold"),
        ProgressBar(1.0, done, min(BAR, width - 8), complete_style="cyan", finished_style="green"),
    )
    return bar


def _lines(facts: list[Fact], width: int, most: int = 10**6) -> list[Text]:
    """The first of them that fit whole into so many rows."""
    lines: list[Text] = []
    for name, text in facts:
        rows = _rows(name, text, width)
        if len(lines) + len(rows) > most:
            break
        lines += rows
    return lines


def _rows(name: str, text: str, width: int, style: str = "bold") -> list[Text]:
    """One of them, on as many rows as it takes."""
    rows = textwrap.wrap(text, max(8, width - LABEL), break_on_hyphens=False)
    return [Text.assemble((f"{'' if i else name:<{LABEL}}", style), row) for i, row in enumerate(rows)]


def _essentials(status: RunStatus) -> list[Fact]:
    rate, learner = status.replay("env_steps_per_s", sum), status.roles.get("learner", {})
    return [
        ("env steps", f"{status.env_steps:,} of {status.total_steps:,}, {number(rate, ',.0f')} /s"),
        ("time", time_and_eta(status.elapsed_s, status.eta_s, status.is_over)),
        ("evaluation", _evaluation(status.last)),
        ("best", _evaluation(status.best)),
        ("updates", f"{number(learner.get('updates'), ',')}, {number(learner.get('updates_per_s'), ',.1f')} /s"),
    ]


def _evaluation(evaluation: EvaluationStatus | None) -> str:
    if evaluation is None:
        return number(None)
    steps = evaluation.env_steps
    at = f"step {steps:,}" if steps is not None else f"update {number(evaluation.update, ',')}"
    note = "" if evaluation.is_complete else ", incomplete"
    return f"{return_text(evaluation.return_mean, evaluation.return_std)} at {at}{note}"


def _details(status: RunStatus) -> list[Fact]:
    """What is known of the rest."""
    learner, ratio = status.roles.get("learner", {}), status.replay("replay_ratio", mean)
    losses = ", ".join(f"{name[:-5]} {number(learner[name])}" for name in learner if name.endswith("_loss"))
    facts = [
        ("episodes", f"return {known_return(status.episode_return)}, with exploration"),
        ("losses", losses or number(None)),
        ("replay", f"ring {number(status.replay('ring_fill', mean), '.0%')} full, "
                   f"ratio {number(ratio, ',.1f')}" + ("" if ratio is None else f" of {status.replay_ratio:g}")),
        ("alpha, beta", f"{number(learner.get('alpha'))}, {number(learner.get('beta'))}"),
        ("curiosity", f"{number(learner.get('curiosity_share'), '.1%')} of the reward"),
        ("latent rank", f"{number(learner.get('latent_rank'), '.1f')}, "
                        f"{number(learner.get('model_unexplained'), '.0%')} of its change unexplained"),
        ("staleness", _staleness(learner)),
        ("policy lag", f"{number(status.replay('policy_lag_mean', mean), ',.1f')} updates"),
    ]  # fmt: skip
    return [(name, text) for name, text in facts if re.search(r"\d|inf|nan", text)]


def _staleness(learner: dict[str, Any]) -> str:
    """Of the states that were replayed, as stored and after the burn-in, and how old what was sampled is."""
    if "stale_state_stored" not in learner:
        return number(None)
    stages = [stage for stage in ("stored", "burned") if f"stale_state_{stage}" in learner]
    state, q = (
        " → ".join(number(learner.get(f"{name}_{stage}"), ".1%") for stage in stages)
        for name in ("stale_state", "stale_q_first")
    )
    return f"state {state}, Q {q}, age {number(learner.get('sample_age_mean'), ',.0f')} updates"


def _groups(status: RunStatus) -> list[dict[str, dict[str, Any]]]:
    """The roles by kind, the launcher left out."""
    kinds: dict[str, dict[str, dict[str, Any]]] = {}
    for role, said in sorted(status.of_this_start().items(), key=lambda one: (len(one[0]), one[0])):
        if role != "launcher":
            kinds.setdefault(role.partition("-")[0], {})[role] = said
    return [kinds[kind] for kind in sorted(kinds, key=lambda kind: (kind == "actor", kind))]


def _roles(status: RunStatus, most: int) -> Table:
    """A row for each role, or for each kind where there would be more than ``most``."""
    groups, silent = _groups(status), status.silent()
    if sum(map(len, groups)) <= most:
        groups = [{role: record} for group in groups for role, record in group.items()]
    roles = plain_table(("role", "busy", "waiting", "for"))
    for group in groups[: max(0, most)]:
        shares = (_share(group, name) for name in ("busy_share", "waiting_share"))
        roles.add_row(count(group), *shares, _reasons(group, silent))
    for column in roles.columns:
        column.no_wrap, column.overflow = True, "ellipsis"
    for column in roles.columns[:3]:  # what there is no room for is cut from the last one
        column.min_width = max(len(str(column.header)), *map(len, map(str, column.cells)), 0)
    return roles


def _share(group: dict[str, dict[str, Any]], name: str) -> str:
    shares = [record[name] for record in group.values() if name in record]
    return number(mean(shares) if shares else None, ".0%")


def _reasons(group: dict[str, dict[str, Any]], silent: dict[str, float]) -> str:
    """What they wait for, and how many have said nothing for long."""
    speaking = [record for role, record in group.items() if role not in silent]
    reasons = [str(one.get("waiting_for", "")) for one in speaking if one.get("waiting_share", 0.0) > 0.005]
    quiet = [silent[role] for role in group if role in silent]
    if quiet:
        some = f"{len(quiet)} " if len(group) > 1 else ""
        reasons.append(f"{some}silent for {max(quiet):.0f} s")
    return ", ".join(dict.fromkeys(filter(None, reasons)))
