"""What a blank frame was, told by the next one that is seen."""

import pytest
import torch
from torch import Tensor

from common.agent import HINDSIGHT, Agent, AgentConfig

T = 9
CONFIG = AgentConfig(
    hidden=8, embedding=7, heads=(16, 15), fill_blanks=True, hindsight=True, normalize_observations=True
)


def told(seen: str, changed: str = "", at: int = 0) -> tuple[Tensor, Tensor]:
    """(T, O) and (T,) of a sequence with these frames seen (1) or not; with an input changed at a step."""
    torch.manual_seed(3)
    agent = Agent(3, 2, CONFIG)
    inputs = {"observation": torch.randn(1, T, 3), "expected": torch.randn(1, T, 3), "action": torch.randn(1, T, 2)}
    if changed:
        inputs[changed][0, at] += 1.0
    assert agent.hindsight is not None
    frames, there = agent.hindsight(
        inputs["observation"], inputs["expected"], torch.tensor([[x == "1" for x in seen]]), inputs["action"]
    )
    return frames.detach()[0], there[0]


def steps_that_differ(seen: str, changed: str, at: int) -> list[int]:
    differ = (told(seen)[0] != told(seen, changed, at)[0]).any(1)
    return differ.nonzero().flatten().tolist()


def test_it_tells_where_a_frame_is_seen_soon_enough() -> None:
    assert HINDSIGHT == 4
    assert told("100000010")[1].tolist() == [False, False, False, True, True, True, True, False, False]
    assert told("111111111")[1].tolist() == [True] * 8 + [False]


@pytest.mark.parametrize(
    ("at", "read_by"),
    [
        (0, [1]),  # the frame before, whatever it is filled with
        (1, [2]),  # not its own: a frame that is seen is told as if it were not
        (4, [1, 2, 3, 5]),  # the next that is seen, and the one before
        (8, [4, 5, 6, 7]),
    ],
)
def test_it_reads_the_frame_before_and_the_next_one_seen_but_never_its_own(at: int, read_by: list[int]) -> None:
    assert steps_that_differ("100010001", "observation", at) == sorted(set(read_by) | ({0} if at == 4 else set()))


def test_it_reads_its_own_expectation_alone() -> None:
    assert steps_that_differ("100010001", "expected", 2) == [2]


def test_it_reads_the_actions_up_to_that_frame() -> None:
    assert steps_that_differ("100010001", "action", 3) == [0, 1, 2, 3]  # a_2
    assert steps_that_differ("100010001", "action", 5) == [4, 5]  # a_4
    assert steps_that_differ("100000010", "action", 2) == [2]  # nothing seen soon enough: a_1, as all have theirs
