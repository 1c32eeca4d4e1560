"""Small agents for the learner's tests, and how far apart two of them compute."""

from torch import Tensor

from rmc.common.agent_config import AgentConfig
from tests.learner.rows import SPEC

PAPER = AgentConfig(hidden=SPEC.state, embedding=0, heads=(10, 9), grounding=False)
ROBUST = AgentConfig(
    hidden=SPEC.state, embedding=7, heads=(10, 9), head_input="hidden+observation", normalize_observations=True
)


def distance(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> dict[str, float]:
    """Between the tensors of a name, as a share of the expected one's norm."""
    return {name: float((actual[name] - value).norm() / value.norm()) for name, value in expected.items()}
