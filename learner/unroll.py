"""The memory over a window: burn-in, then the trained steps; missing observations imputed.

Shapes: B batch, L_b burn-in, L_t trained steps, T both, O observation, A action, S state.
"""

import torch
from torch import Tensor

from rmc.common.agent import Agent, Memory, MemoryOutput
from rmc.learner.batch import Batch


def impute_and_unroll(agent: Agent, o: Tensor, batch: Batch) -> tuple[Tensor, MemoryOutput]:
    """(B, T + 1, O) with missing frames filled where configured, and the memory along them: (B, L_t + 1, ·)."""
    hidden = None
    if agent.next_frame is not None and batch.plan.imputes:
        o, hidden = _impute(agent, o, batch)
    return o, unroll(agent.memory, o, batch, hidden)


def unroll(memory: Memory, o: Tensor, batch: Batch, hidden: Tensor | None = None) -> MemoryOutput:
    """(B, L_t + 1, ·) from the stored state, which starts the trained part itself where the burn-in is padding.

    ``hidden`` is what the burn-in has come to where that is known, (B, H).
    """
    steps, hidden = batch.trained, _burned_in(memory, o, batch) if hidden is None else hidden
    remembered: MemoryOutput = memory(o[:, steps], batch.missing[:, steps], batch.prev_action[:, steps], hidden)
    return remembered


@torch.no_grad()
def _burned_in(memory: Memory, o: Tensor, batch: Batch) -> Tensor:
    """(B, H), the state before the first trained step."""
    n, hidden = batch.burn_in, batch.state[:, : memory.gru.hidden_size]
    if not n:
        return hidden
    burned = memory(o[:, :n], batch.missing[:, :n], batch.prev_action[:, :n], hidden).hidden[:, -1].float()
    torch.clear_autocast_cache()  # older torch would go on with these casts, which carry no gradient
    return torch.where(batch.burned_in.unsqueeze(1), burned, hidden)


def _impute(agent: Agent, o: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """(B, T + 1, O) filled along the states that ``unroll`` goes through, and (B, H) after the burn-in."""

    def part(steps: slice, state: Tensor) -> tuple[Tensor, Tensor]:
        return agent.impute(o[:, steps], batch.missing[:, steps], batch.prev_action[:, steps], state)

    past, state = part(slice(batch.burn_in), batch.state)
    state = torch.where(batch.burned_in.unsqueeze(1), state, batch.state)
    return torch.cat([past, part(batch.trained, state)[0]], 1), state[:, : agent.config.hidden]
