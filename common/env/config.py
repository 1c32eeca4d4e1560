"""Which environment, and what is changed about it; readable without gymnasium."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class EnvConfig:
    """Which environment, and how much of it is seen."""

    id: str
    """Gymnasium id, like HalfCheetah-v5 or dm_control/walker-walk-v0, or module:EnvId-v0 for your own."""
    flicker: float = 0.0
    """Probability that an observation is replaced by zeros, at every step, the reset included."""
    hide: Literal["nothing", "velocities", "positions"] = "nothing"
    """Part of a MuJoCo observation that is left out."""
    noise: float = 0.0
    """Standard deviation of Gaussian noise on every observation, in the observation's own units."""
    frame_stack: int = 1
    """Newest observations that make one, oldest first; a missing frame among them is an ordinary one."""
    action_repeat: int = 1
    """Steps of the environment for one of the agent's; rewards are added up. Other options count the agent's steps."""
    time_limit: int = 0
    """Steps of the environment after which an episode is cut off; 0 keeps the environment's own limit."""
    env_timeout: float = 60.0
    """Seconds after which a call into an environment hangs: its making, reset, step, render or close. Its process ends;
    a role's is started again."""
