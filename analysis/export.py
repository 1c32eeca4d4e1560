"""A policy as an ONNX file, for programs without torch.

Inputs: observation (N, O) raw, previous_action (N, A), missing (N,) bool, state (N, S), zeros at an episode's start.
Where its environment says by number what is missing, that is (N, O).
Outputs: action (N, A) in [-1, 1], the policy's mean, and next_state (N, S).
The model's metadata hold the policy's header, as its safetensors do.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from rmc.analysis.policy_file import PolicyFile
from rmc.common.agent import Agent
from rmc.common.extra import check_installed
from rmc.common.whole_file import written_whole

INPUTS, OUTPUTS = ("observation", "previous_action", "missing", "state"), ("action", "next_state")


class _Step(nn.Module):
    """One step of the policy's mean."""

    def __init__(self, agent: Agent, takes_odd: bool) -> None:
        """``takes_odd``: what is not finite counts as missing."""
        super().__init__()
        self.agent, self._takes_odd = agent, takes_odd

    def forward(
        self, observation: Tensor, previous_action: Tensor, missing: Tensor, state: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See the module's docstring."""
        by_number = missing.ndim == 2
        missing = missing if by_number else missing.unsqueeze(1)
        if self._takes_odd:
            odd = ~torch.isfinite(observation)
            missing = missing | (odd if by_number else odd.any(1, keepdim=True))
        normalized = self.agent.normalizer(observation, missing).unsqueeze(1)
        now = missing.unsqueeze(1), previous_action.unsqueeze(1), state
        remembered, _, state = self.agent.unroll(normalized, *now)
        mean, _ = self.agent.policy(self.agent.features(remembered).squeeze(1))
        return torch.tanh(mean), state


def export(policy: PolicyFile, out: Path) -> None:
    """Write a policy to ``out``, its header in the model's metadata. Raises ConfigError."""
    check_installed("onnx", ("onnx", "onnxscript"), "--out", str(out))
    header = policy.header
    flags = header.layout.missing
    agent = Agent(header.obs_dim, header.action_dim, header.agent, flags)
    agent.load_state_dict(safetensors.torch.load(policy.blob), strict=False)
    two = [torch.zeros(2, size) for size in header.sizes().values()]
    missing = torch.zeros((2, flags) if flags > 1 else (2,), dtype=torch.bool)
    example = (two[0], two[1], missing, two[2])
    takes_odd = header.agent.impute_missing and header.layout.frames == 1  # as ``Policy.act`` has it
    rows = torch.export.Dim("rows", min=1)
    with _quiet():
        program = torch.onnx.export(
            _Step(agent, takes_odd).eval(), example, input_names=INPUTS, output_names=OUTPUTS,
            dynamic_shapes=({0: rows},) * 4, dynamo=True,
        )  # fmt: skip
        assert program is not None
        program.model.metadata_props.update(header.metadata())
        with written_whole(out) as temporary:
            program.save(str(temporary), external_data=False)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """The exporter tells of its own steps and of deprecations in its own code."""
    exporter = logging.getLogger("torch.onnx")
    level = exporter.level
    exporter.setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            exporter.setLevel(level)
