"""What a user should notice about a run: what is wrong with it, and who waits for what."""

from collections import defaultdict
from statistics import mean
from typing import Any

from rmc.deploy.monitor.figures import number
from rmc.deploy.monitor.run_status import WAITING_SHARE, RunStatus

MOST_SILENT = 3  # that are named
STALLED_SECONDS = 60.0  # after which a run in which all wait is said to hang


def notices(status: RunStatus) -> dict[str, str]:
    """What is not as it should be, by its heading."""
    off = status.replay("replay_ratio_off", max)
    restarts, broken = status.get("launcher", "restarts"), status.broken_episodes
    texts = {
        "not running": "" if status.is_over else status.get("launcher", "not_running"),
        "silent": _silent(status),
        "deadlock": _deadlock(status.stalled_s),
        "not saved": status.get("learner", "checkpoint_error"),
        "damaged": _damaged(status),
        "replay ratio": f"far from {status.replay_ratio:g}, see the troubleshooting page" if off else "",
        "restarts": f"{number(restarts, ',')} of roles that died" if restarts else "",
        "broken": f"{number(broken, ',')} episodes, by the environment's faults" if broken else "",
    }
    return {name: str(text) for name, text in texts.items() if text}


def waits(status: RunStatus) -> str:
    """Who waits most of the time, and for what; roles of a kind that wait for the same are counted."""
    silent = status.silent()
    groups: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for role, record in sorted(status.of_this_start().items()):
        share, reason = record.get("waiting_share", 0.0), record.get("waiting_for")
        if role not in silent and share > WAITING_SHARE and reason and role != "evaluator":
            groups[role.partition("-")[0], str(reason)][role] = share
    return ", ".join(f"{count(shares)} {mean(shares.values()):.0%} for {why}" for (_, why), shares in groups.items())


def count(roles: dict[str, Any]) -> str:
    """The name of one, or how many of a kind: ``8 actors``."""
    first = next(iter(roles))
    kind = {"actor": "actors", "replay": "replay servers"}.get(first.partition("-")[0], "roles")
    return first if len(roles) == 1 else f"{len(roles)} {kind}"


def _damaged(status: RunStatus) -> str:
    """What was found damaged and passed over."""
    counts = {"windows of the ring": status.replay("damaged_windows", sum)}
    counts["newer checkpoints"] = status.get("learner", "damaged_checkpoints")
    return ", ".join(f"{number(count, ',')} {name}" for name, count in counts.items() if count)


def _deadlock(seconds: float) -> str:
    return f"no step and no update for {seconds:,.0f} s, see rmc doctor" if seconds > STALLED_SECONDS else ""


def _silent(status: RunStatus) -> str:
    roles = [f"{who} for {seconds:,.0f} s" for who, seconds in status.silent().items()]
    more = len(roles) - MOST_SILENT
    return ", ".join(roles[:MOST_SILENT]) + (f" and {more} more" if more > 0 else "")
