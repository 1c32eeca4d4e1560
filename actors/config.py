"""How actors and the evaluator are configured."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class EvaluatorConfig:
    """Evaluation during training."""

    episodes: int = 5
    """Episodes per evaluation, played with the policy's mean, one after the other. 0 evaluates before and after
    training alone, with no evaluator beside the actors."""
    evaluation_seconds: float = 300.0
    """Time limit of an evaluation, in seconds; 0 is none, as in lockstep. Finished episodes count; if none finished,
    the first one's return so far."""


@dataclass(frozen=True)
class ActorConfig:
    """Actors: environments, windows, how often weights come."""

    envs_per_actor: int = 4
    """N, environments of one actor; more of them share one forward pass."""
    stride: int = 0
    """Steps between window starts. Below --trained-steps windows overlap; 0 means --trained-steps, the most."""
    state_strategy: Literal["zero", "stored", "burn-in", "episode"] = "burn-in"
    """A window's first memory state. zero: zeros. stored: the actor's. burn-in: the actor's, some steps before.
    episode: zeros; the window is the whole episode, up to the time limit."""
    reward_scale: float = 1.0
    """Factor on the rewards that are learnt from; reported returns are unscaled."""
    refresh_steps: int = 400
    """Agent steps of an actor between two checks for new weights."""
    chunk_windows: int = 16
    """Windows after which an actor sends an entry; it also ends at 1 MiB."""
    chunk_seconds: float = 0.5
    """Seconds after which an incomplete entry is sent."""
    unacked_bytes: int = 64 << 20
    """Maximum bytes of unacknowledged windows; the actor pauses there."""
