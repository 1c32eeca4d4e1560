"""How the replay server is configured."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ReplayConfig:
    """The replay buffer: its size, what is drawn from it and how often."""

    capacity: int = 70_000
    """Windows kept; the oldest are overwritten."""
    replay_ratio: float = 128.0
    """Trained steps drawn per new agent step, from the end of the warm-up on."""
    warmup_steps: int = 5_000
    """Agent steps before the first draw."""
    priority_exponent: float = 0.6
    """How strongly priorities steer sampling; 0 is uniform."""
    replay_shards: int = 1
    """Replay servers, each with a share of the actors and of the capacity."""
