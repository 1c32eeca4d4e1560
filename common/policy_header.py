"""What a policy's file says about itself, so that it can act without its run; readable without torch.

The header is JSON in the file's metadata, of safetensors and ONNX alike, under ``METADATA_KEY``.
Shapes: O observation, A action, S state.
"""

import dataclasses
import json
from dataclasses import dataclass

from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig
from rmc.common.env.layout import EnvLayout
from rmc.common.return_text import return_text

METADATA_KEY = "rmc.policy"


@dataclass(frozen=True)
class PolicyHeader:
    """Sizes, options and origin of a policy."""

    format: int
    """Of these facts, as ``config.json`` counts its own: what is in both has the same names."""
    rmc: str
    """The version of RMC that wrote it."""
    env: EnvConfig
    """The environment that it was trained in."""
    layout: EnvLayout
    """What it reads and gives."""
    agent: AgentConfig
    """Sizes and switches of its networks."""
    preset: str
    seed: int
    """The run's."""
    env_steps: int = 0
    """Agent steps that it was trained for."""
    updates: int = 0
    eval_return_mean: float | None = None
    """Of deterministic episodes; None where this checkpoint was not evaluated."""
    eval_return_std: float | None = None
    eval_episodes: int = 0

    @property
    def obs_dim(self) -> int:
        """O."""
        return self.layout.obs_dim

    @property
    def action_dim(self) -> int:
        """A."""
        return self.layout.action_dim

    def sizes(self) -> dict[str, int]:
        """O, A and S by name."""
        return {"observation": self.obs_dim, "action": self.action_dim, "state": self.agent.state_size(self.obs_dim)}

    def summary(self) -> str:
        """Where it comes from and how good it is, in a line."""
        returns = self.returns()
        judged = f"return {returns}" if returns else "not evaluated"
        return f"{self.env.label()} after {self.env_steps:,} steps, {judged}"

    def returns(self) -> str:
        """Its evaluation in words; empty where there was none."""
        if self.eval_return_mean is None or self.eval_return_std is None:
            return ""
        episodes = f"{self.eval_episodes} episode{'s' * (self.eval_episodes != 1)}"
        return f"{return_text(self.eval_return_mean, self.eval_return_std)} over {episodes}"

    def metadata(self) -> dict[str, str]:
        """For a file's own metadata, which holds text."""
        return {METADATA_KEY: json.dumps(dataclasses.asdict(self) | {"sizes": self.sizes()})}
