"""How the replay server is configured."""

from dataclasses import dataclass

from rmc.common.errors import ConfigError


@dataclass(frozen=True)
class ReplayConfig:
    """The replay server's options."""

    capacity: int = 70_000
    """Windows kept; the oldest make room."""
    replay_ratio: float = 128.0
    """Trained steps drawn per new environment step, from the end of the warm-up on."""
    warmup_steps: int = 5_000
    """Environment steps before the first draw."""
    priority_exponent: float = 0.6
    """How strongly priorities steer sampling; 0 is uniform."""
    replay_shards: int = 1
    """Replay servers, each with a share of the actors and of the capacity."""

    def __post_init__(self) -> None:
        if self.capacity < 1:
            raise ConfigError("--capacity", self.capacity, "take at least 1 window")
        if not 0.0 < self.replay_ratio < float("inf"):
            raise ConfigError("--replay-ratio", self.replay_ratio, "take a positive number, like 128")
        if self.warmup_steps < 0:
            raise ConfigError("--warmup-steps", self.warmup_steps, "take 0 or more")
        if not 0.0 <= self.priority_exponent <= 4.0:
            raise ConfigError("--priority-exponent", self.priority_exponent, "take 0 (uniform) to 4")
