"""The state of a run as one line, for where there is no terminal."""

from rmc.deploy.monitor.figures import number, time_and_eta
from rmc.deploy.monitor.notices import notices, waits
from rmc.deploy.monitor.run_status import RunStatus


def line(board: RunStatus) -> str:
    """How far it is, how fast, how good, and what holds it back."""
    parts = [
        f"{board.share_done:.0%}",
        f"{board.env_steps:,} of {board.total_steps:,} steps",
        f"{number(board.get('learner', 'updates_per_s'), ',.0f')} updates/s",
        _evaluation(board),
        time_and_eta(board.elapsed_s, board.eta_s, board.is_over),
        *(f"{name}: {text}" for name, text in notices(board).items()),
    ]
    if waiting := waits(board):
        parts.append(f"waiting: {waiting}")
    return " | ".join(parts)


def _evaluation(board: RunStatus) -> str:
    if board.last is None or board.best is None:
        return f"eval {number(None)}"
    return f"eval {_return(board.last.return_mean)} (best {_return(board.best.return_mean)})"


def _return(value: float) -> str:
    """Whole where it is large."""
    return number(value, ",.0f" if abs(value) >= 1000 else ",.4g")
