"""The newest state of a run as a table for a terminal, or as one plain line."""

import sys
import threading
import time
from collections.abc import Callable
from statistics import mean
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rmc.common.bus.metrics_record import is_finite
from rmc.deploy.monitor.output import unfailing

NONE_YET = "-"
REFRESH_SECONDS = 0.5  # of a live view
LINE_SECONDS = 10.0  # between plain lines
MOST_NAMES = 1000
LARGEST_STEP = 2**63 - 1  # that TensorBoard takes
SILENT_SECONDS = 5.0  # after which a role's silence is shown; it speaks every second
LAUNCHER_SECONDS = 15.0  # the same of the launcher, which speaks every 5
UNHEARD_SECONDS = 30.0  # of a role that has not spoken yet: it imports, and makes its environments
MOST_SILENT = 3  # that are named


def terminal(width: int | None = None) -> Console:
    """What is printed, shown as it is: a name may hold what a console takes for markup."""
    return Console(file=unfailing(sys.stdout), width=width, markup=False, emoji=False, highlight=False)


class RunStatus:
    """The newest value of everything, by role."""

    def __init__(
        self,
        env: str,
        preset: str,
        seed: int,
        total_steps: int,
        replay_ratio: float,
        expected: tuple[str, ...] = (),
    ) -> None:
        """``expected`` are the roles that are about to speak."""
        self._since = dict.fromkeys(expected, time.time())  # of those that have not spoken
        self.is_over = False  # then nobody is expected to speak
        self.env, self.preset, self.seed, self.total_steps = env, preset, seed, total_steps
        self.replay_ratio = replay_ratio
        self.roles: dict[str, dict[str, Any]] = {}

    def take(self, record: dict[str, Any]) -> None:
        """Take in a record; what it does not name stays as it was, and of a role there are ``MOST_NAMES`` at most."""
        known = self.roles.get(record["role"], {})
        room = MOST_NAMES - len(known)
        new = record if len(record) <= room else {name: record[name] for name in record if name in known}
        self.roles = {**self.roles, record["role"]: known | new}  # afresh: another thread may be reading the old one

    def silent(self) -> dict[str, float]:
        """Who has said nothing for long, and for how many seconds. While Redis is away, which is why, it alone."""
        if self.is_over:
            return {}
        now, launcher = time.time(), self.roles.get("launcher", {})
        if launcher.get("redis_away_s"):
            return {"Redis": launcher["redis_away_s"] + now - launcher.get("time", now)}
        unheard = {role: now - since for role, since in self._since.items() if role not in self.roles}
        quiet = {role: now - record.get("time", now) for role, record in self.roles.items()}
        return {role: seconds for role, seconds in unheard.items() if seconds > UNHEARD_SECONDS} | {
            role: seconds
            for role, seconds in sorted(quiet.items())
            if seconds > (LAUNCHER_SECONDS if role == "launcher" else SILENT_SECONDS)
        }

    def get(self, role: str, name: str) -> Any:
        """The newest value, or None."""
        return self.roles.get(role, {}).get(name)

    @property
    def env_steps(self) -> int:
        """Environment steps committed to the ring."""
        steps = self.replay("env_steps", sum) or self.get("learner", "env_steps") or 0
        return _steps(steps) or 0

    def checkpoint_steps(self, update: int | None) -> int | None:
        """Environment steps at the checkpoint of that update, or None where the learner has said them of another."""
        steps = self.get("learner", "checkpoint_env_steps")
        known = update is not None and update == self.get("learner", "checkpoint_update")
        return _steps(steps) if known else None

    def replay(self, name: str, over: Callable[[list[float]], float]) -> float | None:
        """The sum or mean ``over`` all replay servers, or None."""
        found = [record[name] for role, record in self.roles.items() if role.startswith("replay") and name in record]
        return over(found) if found else None

    @property
    def episode_return(self) -> float | None:
        """Mean of the actors' newest episode returns."""
        values = [record["episode_return_mean"] for record in self.roles.values() if "episode_return_mean" in record]
        return sum(values) / len(values) if values else None

    @property
    def policy_lag(self) -> float | None:
        """Weight versions between what acts and the newest, at insertion."""
        return self.replay("policy_lag_mean", mean)

    @property
    def episodes(self) -> str:
        """The episodes' return, and how many the environment's own faults have ended."""
        broken = sum(record.get("broken_episodes", 0) for record in self.roles.values())
        return number(self.episode_return, ",.1f") + (f", {broken} broken" if broken else "")


def _steps(value: Any) -> int | None:
    """Steps out of a record; None where they can be none."""
    return min(int(value), LARGEST_STEP) if is_finite(value) and value >= 0 else None


def number(value: Any, form: str = ",.3g") -> str:
    """A number as text, or a hyphen where there is none yet."""
    return NONE_YET if value is None else format(value, form)


def _evaluation(board: RunStatus) -> str:
    mean, deviation, update = (
        board.get("evaluator", f"eval_{name}") for name in ("return_mean", "return_std", "update")
    )
    said = f"{number(mean, ',.1f')} ± {number(deviation, ',.1f')} at update {number(update, ',')}"
    return NONE_YET if mean is None else said


def _staleness(learner: dict[str, Any]) -> str:
    """Of the states that were replayed, as stored and after the burn-in, and how old what was sampled is."""
    if "stale_state_stored" not in learner:
        return NONE_YET
    stages = [stage for stage in ("stored", "burned") if f"stale_state_{stage}" in learner]
    state, q = (
        " → ".join(number(learner.get(f"{name}_{stage}"), ".1%") for stage in stages)
        for name in ("stale_state", "stale_q_first")
    )
    return f"state {state}, Q {q}, age {number(learner.get('sample_age_mean'), ',.0f')} updates"


def _facts(board: RunStatus) -> list[tuple[str, str]]:
    learner = board.roles.get("learner", {})
    losses = ", ".join(f"{name[:-5]} {number(learner[name])}" for name in learner if name.endswith("_loss"))
    return [
        ("environment steps", f"{board.env_steps:,} of {board.total_steps:,}, "
                              f"{number(board.replay('env_steps_per_s', sum), ',.0f')} /s"),
        ("updates", f"{number(learner.get('updates'), ',')}, {number(learner.get('updates_per_s'), ',.1f')} /s"),
        ("replay", f"ring {number(board.replay('ring_fill', mean), '.0%')} full, "
                   f"ratio {number(board.replay('replay_ratio', mean), ',.1f')} of {board.replay_ratio:g}"),
        ("episode return", board.episodes),
        ("evaluation return", _evaluation(board)),
        ("losses", losses or NONE_YET),
        ("alpha, beta", f"{number(learner.get('alpha'))}, {number(learner.get('beta'))}"),
        ("curiosity in reward", number(learner.get("curiosity_share"), ".1%")),
        ("latent rank", f"{number(learner.get('latent_rank'), '.1f')}, "
                        f"{number(learner.get('model_unexplained'), '.0%')} of its change unexplained"),
        ("staleness", _staleness(learner)),
        ("weights", f"version {number(learner.get('updates'), ',')}, lag {number(board.policy_lag, ',.1f')} updates"),
    ]  # fmt: skip


def _stages(board: RunStatus) -> Table:
    stages = Table("role", "busy", "waiting", "for", "restarts", box=None, padding=(0, 2, 0, 0), title_justify="left")
    silent = board.silent()
    for role in sorted(role for role in board.roles if role != "launcher"):
        record = board.roles[role]
        reason = f"{record.get('waiting_for', '')}" if record.get("waiting_share", 0.0) > 0.005 else ""
        stages.add_row(
            role,
            number(record.get("busy_share"), ".0%"),
            number(record.get("waiting_share"), ".0%"),
            f"silent for {silent[role]:.0f} s" if role in silent else reason,
            str(board.get("launcher", f"restarts_{role}") or 0),
        )
    return stages


def _damaged(board: RunStatus) -> str:
    """What was found damaged and passed over."""
    counts = {"windows of the ring": board.replay("damaged_windows", sum)}
    counts["newer checkpoints"] = board.get("learner", "damaged_checkpoints")
    return ", ".join(f"{number(count, ',')} {name}" for name, count in counts.items() if count)


def _silent(board: RunStatus) -> str:
    found = [f"{who} for {seconds:,.0f} s" for who, seconds in board.silent().items()]
    more = len(found) - MOST_SILENT
    return ", ".join(found[:MOST_SILENT]) + (f" and {more} more" if more > 0 else "")


def notices(board: RunStatus) -> dict[str, str]:
    """What is not as it should be, by its heading."""
    off = board.replay("replay_ratio_off", max)
    found = {
        "not running": board.get("launcher", "not_running"),
        "silent": _silent(board),
        "not saved": board.get("learner", "checkpoint_error"),
        "damaged": _damaged(board),
        "replay ratio": f"far from {board.replay_ratio:g}, see the troubleshooting page" if off else "",
    }
    return {name: str(text) for name, text in found.items() if text}


def table(board: RunStatus) -> Group:
    """Everything, for a terminal."""
    facts = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    facts.add_column(style="bold")
    facts.add_column()
    for name, value in _facts(board):
        facts.add_row(name, value)
    for name, text in notices(board).items():
        facts.add_row(name, text)
    title = Text.assemble((board.env, "bold"), f" · {board.preset} · seed {board.seed}")
    return Group(title, facts, _stages(board))


def line(board: RunStatus) -> str:
    """The same in one line, shorter."""
    learner, silent = board.roles.get("learner", {}), board.silent()
    waits = [
        f"{role} {record['waiting_share']:.0%} for {record['waiting_for']}"
        for role, record in sorted(board.roles.items())
        if role not in silent
        and record.get("waiting_share", 0.0) > 0.5
        and record.get("waiting_for")
        and role != "evaluator"
    ]
    parts = [
        f"steps {board.env_steps}/{board.total_steps}",
        f"{number(board.replay('env_steps_per_s', sum), '.0f')} steps/s",
        f"updates {number(learner.get('updates'), '.0f')}",
        f"{number(learner.get('updates_per_s'), '.1f')}/s",
        f"ring {number(board.replay('ring_fill', mean), '.0%')}",
        f"ratio {number(board.replay('replay_ratio', mean), '.1f')}/{board.replay_ratio:g}",
        f"episode {board.episodes}",
        f"eval {number(board.get('evaluator', 'eval_return_mean'), '.1f')}",
        f"q {number(learner.get('q_loss'))} model {number(learner.get('model_loss'))}",
        f"alpha {number(learner.get('alpha'))} beta {number(learner.get('beta'))}",
        f"curiosity {number(learner.get('curiosity_share'), '.1%')}",
        f"rank {number(learner.get('latent_rank'), '.1f')}",
        f"lag {number(board.policy_lag, '.1f')}",
        f"restarts {board.get('launcher', 'restarts') or 0}",
    ]
    parts += [f"{name}: {text}" for name, text in notices(board).items()]
    return " | ".join(parts) + (f" | waiting: {', '.join(waits)}" if waits else "")


class View:
    """A board shown on a console, live where that is a terminal; by a thread, whatever its owner waits for."""

    def __init__(self, board: RunStatus, console: Console) -> None:
        self._board, self._console, self._due = board, console, 0.0
        self._lock, self._over = threading.Lock(), threading.Event()
        self._live: Live | None = None
        if console.is_terminal:
            self._live = Live(table(board), console=console, auto_refresh=False)
            self._live.start()
        self._thread = threading.Thread(target=self._draw, name="view", daemon=True)
        self._thread.start()

    def _draw(self) -> None:
        while not self._over.wait(REFRESH_SECONDS):
            self.refresh()

    def refresh(self) -> None:
        """Show the newest state if it is time."""
        with self._lock:
            if time.monotonic() >= self._due:
                self._due = time.monotonic() + (REFRESH_SECONDS if self._live else LINE_SECONDS)
                self._show()

    def _show(self) -> None:
        if getattr(self._console.file, "lost", False):  # nobody sees it
            return
        if self._live is not None:
            self._live.update(table(self._board), refresh=True)
        else:
            self._console.print(line(self._board), soft_wrap=True)

    def close(self) -> None:
        """Show the last state, and leave it there."""
        self._over.set()
        self._thread.join()
        self._board.is_over = True
        self._show()
        if self._live is not None:
            self._live.stop()
