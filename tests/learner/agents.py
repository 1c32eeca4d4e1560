"""Small agents for the learner's tests."""

from rmc.common.agent_config import AgentConfig
from tests.learner.rows import SPEC

PAPER = AgentConfig(hidden=SPEC.state, embedding=0, heads=(10, 9), grounding=False)
ROBUST = AgentConfig(
    hidden=SPEC.state, embedding=7, heads=(10, 9), head_input="hidden+observation", normalize_observations=True
)
