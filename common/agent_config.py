"""Sizes and switches of the agent's networks, readable without torch."""

from dataclasses import dataclass
from typing import Literal

LOG_STD_RANGE = (-20.0, 2.0)  # of the policy's Gaussian before the tanh
NORMALIZED_CLIP = 10.0  # standard deviations
STD_FLOOR = 1e-2  # of a number of an observation: one that is constant is not blown up
HeadInput = Literal["hidden", "hidden+observation", "observation"]
POLICY_PARTS = ("normalizer.", "memory.", "policy.", "next_frame.")  # what it takes to act
CRITIC_PARTS = ("critic.", "log_alpha", "privileged_normalizer.")  # what else it takes to rate a window


@dataclass(frozen=True)
class AgentConfig:
    """Sizes and switches of the networks; the same in every role of a run."""

    hidden: int = 256
    """H, units of the GRU."""
    embedding: int = 256
    """E, units of the Linear + ReLU before the GRU; 0 feeds the raw input (the paper)."""
    heads: tuple[int, int] = (400, 300)
    """Units of the two hidden layers of every head, like 400 300."""
    gate_init: Literal["uniform", "chrono"] = "uniform"
    """Initial bias of the GRU's update gates. uniform: PyTorch's. chrono: time constants up to a window's length."""
    head_input: HeadInput = "hidden"
    """What the heads read: the hidden state; the observation beside it; or the observation alone, without a memory."""
    critic_batch_norm: bool = False
    """Batch norm in the critics, as CrossQ has it: Q of this and the next state share one pass; no target critics."""
    privileged_critic: bool = False
    """Critics alone also read info["privileged"], or the observation before any option takes from it."""
    normalize_observations: bool = False
    """Observations are normalised by the replay server's running statistics."""
    grounding: bool = True
    """The world model also predicts the next observation's change and the reward."""
    missing_flag: bool = False
    """The memory also reads whether the observation is missing, or which of its dimensions are."""
    impute_missing: bool = False
    """A small network fills missing observations before the memory reads them. Needs normalized observations."""
    initial_priority: Literal["max", "actor"] = "max"
    """A window's first priority: the largest there, or its actor's TD error; actors are sent the critics for that."""

    def input_size(self, obs_dim: int, action_dim: int, missing: int) -> int:
        """Numbers that the memory reads at a step, before the embedding: o_t, a_{t-1}, and M flags where asked."""
        return obs_dim + action_dim + missing * self.missing_flag

    def skip_size(self, obs_dim: int) -> int:
        """Numbers that the heads read beside h, or in its place: o_t."""
        return 0 if self.head_input == "hidden" else obs_dim

    def feature_size(self, skip_size: int) -> int:
        """Numbers that the heads read in all."""
        return skip_size + (self.hidden if self.head_input != "observation" else 0)

    def state_size(self, obs_dim: int) -> int:
        """S, numbers that an actor carries from step to step, and stores: h, and the last frame where it fills."""
        return self.hidden + self.impute_missing * obs_dim
