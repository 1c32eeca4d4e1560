"""The state of a run as one line, for where there is no terminal."""

from rmc.common.return_text import return_text
from rmc.deploy.monitor.figures import known_return, number, time_and_eta
from rmc.deploy.monitor.notices import notices, waits
from rmc.deploy.monitor.run_status import RunStatus


def line(status: RunStatus) -> str:
    """How far it is, how fast, how good, and what holds it back."""
    parts = [
        f"{status.share_done:.0%}",
        f"{status.env_steps:,} of {status.total_steps:,} steps",
        f"{number(status.get('learner', 'updates_per_s'), ',.0f')} updates/s",
        _evaluation(status),
        time_and_eta(status.elapsed_s, status.eta_s, status.is_over),
        *(f"{name}: {text}" for name, text in notices(status).items()),
    ]
    if waiting := waits(status):
        parts.append(f"waiting: {waiting}")
    return " | ".join(parts)


def _evaluation(status: RunStatus) -> str:
    last, best = status.last, status.best
    if last is None:
        return f"eval {number(None)}"
    note = "" if last.is_complete else "incomplete; "
    return f"eval {return_text(last.return_mean)} ({note}best {known_return(best.return_mean if best else None)})"
