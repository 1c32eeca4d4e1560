"""How actors and the evaluator are configured."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class EvaluatorConfig:
    """Evaluation during training."""

    episodes: int = 5
    """Episodes per evaluation, played with the policy's mean. 0: only before and after training, with no evaluator."""
    evaluation_seconds: float = 300.0
    """Seconds that an evaluation may take; 0: no limit, as in lockstep. Episodes that have ended count."""


@dataclass(frozen=True)
class ActorConfig:
    """Actors: environments, windows, how often weights come."""

    envs_per_actor: int = 4
    """N, environments of one actor; more of them share one forward pass."""
    stride: int = 0
    """Steps between window starts. Below --trained-steps windows overlap; 0 means --trained-steps, the most."""
    state_strategy: Literal["zero", "stored", "burn-in", "episode"] = "burn-in"
    """A window's first state: zero; stored, the actor's; burn-in, the actor's some steps before; episode, its start."""
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
