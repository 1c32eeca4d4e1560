"""How far back a memory can learn, beside how long an episode lasts, in one line."""

from rmc.common.env.registered import PYBULLET
from rmc.deploy.run.config import RunConfig


def format_reach(trained_steps: int, time_limit: int | None) -> str:
    """What windows of so many trained steps leave out of episodes of up to ``time_limit`` steps of the agent.

    No loss reaches back further than a window's trained steps: the burn-in before them passes no gradient.
    """
    if time_limit is not None and time_limit <= trained_steps:
        return f"the memory can learn over whole episodes, of up to {time_limit:,} steps"
    if time_limit is None:
        length = "episodes have no known time limit"
        more = "--trained-steps, or --time-limit and --state-strategy episode"
    else:
        length, more = f"episodes last up to {time_limit:,}", "--trained-steps, or --state-strategy episode"
    return f"the memory cannot learn of anything older than {trained_steps:,} steps; {length} ({more})"


def reach_note(config: RunConfig) -> str | None:
    """That line where it matters: something older may count, and observations may not show it. Raises ConfigError."""
    steps, time_limit = config.window_spec().train, config.layout.time_limit
    is_whole = time_limit is not None and time_limit <= steps
    shipped = config.env.id.startswith(PYBULLET)  # with positions or velocities alone
    may_hide = config.env.takes_away() or shipped or ":" in config.env.id  # options say so, or it is the user's own
    if is_whole or config.agent.head_input == "observation" or not may_hide:
        return None
    return format_reach(steps, time_limit)
