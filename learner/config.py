"""How the learner runs, and the algorithm's constants, readable without torch."""

from dataclasses import dataclass
from typing import Literal

Precision = Literal["auto", "bf16", "fp32"]
MODEL_PROCESS = "rmc learner: memory and world model"  # the title of the process that has this half of an update


@dataclass(frozen=True)
class UpdateConfig:
    """The algorithm: learning rates, discount, losses."""

    learning_rate: float = 3e-4
    """Adam's learning rate for every network."""
    memory_learning_scale: float = 1.0
    """The memory's learning rate, as a multiple of the others'."""
    alpha_learning_rate: float = 3e-4
    """Adam's learning rate for the temperature."""
    target_entropy: float = -1.0
    """What the temperature holds the policy's entropy at, in nats for each dimension of the action."""
    gamma: float = 0.99
    """Discount per step of the agent."""
    polyak: float = 0.995
    """Share of itself that a target network keeps at every update."""
    clip_norm: float = 0.0
    """Largest gradient norm of an optimiser's step; 0 does not clip."""
    latent_target: Literal["online", "ema"] = "online"
    """Which memory gives the change that the world model predicts."""
    target_memory: Literal["online", "ema"] = "online"
    """Which memory gives the next state that a target's Q reads."""
    policy_q: Literal["first", "min"] = "min"
    """Which Q the policy maximises: Q_1 (the paper) or the smaller of the two."""
    curiosity: float = 0.0
    """beta_0, weight of the curiosity reward at the start; 0 switches it off."""
    curiosity_scale: Literal["raw", "std"] = "raw"
    """Curiosity as it is (the paper), or divided by its running standard deviation."""
    curiosity_steps: int = 100_000
    """Agent steps after which beta has decayed to 0, linearly."""
    scheme: Literal[1, 2, 3, 4, 5, 6] = 1
    """What trains the memory: 1 model and value, 2 value, 3 model, 4 all, 5 model and policy, 6 value and policy."""
    policy_through_q: bool = True
    """In schemes 4 to 6 the policy's loss reaches the memory by the state that Q reads, too."""
    update_order: Literal["joint", "alternate"] = "joint"
    """joint: one step of all losses. alternate: one loss after the other, each with its optimiser (algorithm 1)."""
    model_norm: Literal["l1", "l2"] = "l1"
    """How the world model's error is measured, as loss and as curiosity."""
    policy_delay: int = 1
    """k: the policy trains at every k-th update; critics and temperature train at each."""
    n_step: int = 1
    """Steps of reward in a target before it bootstraps; 1 is the paper."""
    eta: float = 0.9
    """Weight of the largest against the mean absolute TD error in a window's priority."""

    policy_ema_updates: int = 0
    """Updates that the saved and evaluated policy averages over, a tenth of those made at most; below 10: off."""

    def halves_are_apart(self) -> bool:
        """Whether memory and world model read nothing of critics, policy and temperature, nor of a common norm."""
        online = self.latent_target == self.target_memory == "online"
        return self.scheme == 3 and self.update_order == "joint" and online and not self.clip_norm

    def beta(self, env_steps: int) -> float:
        """beta after so many agent steps."""
        return self.curiosity * max(0.0, 1.0 - env_steps / self.curiosity_steps)


@dataclass(frozen=True)
class LearnerConfig:
    """The learner: batches, checkpoints, threads."""

    batch_size: int = 64
    """B, windows in a batch."""
    importance_exponent: float = 0.4
    """How far importance weights undo prioritized sampling; 1 is wholly."""
    publish_updates: int = 20
    """Updates after which the policy is published to the actors again."""
    checkpoint_steps: int = 10_000
    """Agent steps between checkpoints. The evaluator plays the newest one whenever it is free."""
    keep_checkpoints: int = 3
    """Newest checkpoints kept, beside the best."""
    precision: Precision = "auto"
    """Of matrix products. auto: bfloat16 where the CPU has instructions for it, TensorFloat-32 on a GPU."""
    threads: int = 0
    """The learner's CPU threads; 0 finds the fastest number. With scheme 3, 0 or 2 and more take two processes."""
