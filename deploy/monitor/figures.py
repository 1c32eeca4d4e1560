"""Numbers and durations as text."""

from typing import Any

from rmc.common.bus.metrics_record import is_finite
from rmc.common.return_text import return_text

NONE_YET = "–"
DAY, LONGEST = 86_400, 999 * 86_400  # seconds


def number(value: Any, form: str = ",.3g") -> str:
    """A number as text, or a dash where there is none yet."""
    return NONE_YET if value is None else format(value, form)


def known_return(value: float | None) -> str:
    """A return as text, or a dash where there is none yet."""
    return NONE_YET if value is None else return_text(value)


def time_and_eta(elapsed_s: float | None, eta_s: float | None, is_over: bool) -> str:
    """Like 0:21:10, ETA 2:31:00; of what is over no ETA."""
    return duration(elapsed_s) if is_over else f"{duration(elapsed_s)}, ETA {duration(eta_s)}"


def duration(seconds: float | None) -> str:
    """Like 0:21:10, or 3d 2:00:00; a dash where it is not known."""
    if not is_finite(seconds) or seconds < 0:
        return NONE_YET
    whole = int(min(seconds, LONGEST))
    days, rest = divmod(whole, DAY)
    clock = f"{rest // 3600}:{rest // 60 % 60:02}:{rest % 60:02}"
    return f"{days}d {clock}" if days else clock
