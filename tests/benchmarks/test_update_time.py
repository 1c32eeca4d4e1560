"""What a sampled stack of the learner counts as."""

from pathlib import Path
from types import ModuleType

import pytest

from benchmarks import update_time
from rmc.learner.bfloat16 import fused_heads, rounded
from rmc.learner.replay import client


def frame(module: ModuleType, function: str, text: str) -> str:
    lines = Path(str(module.__file__)).read_text().splitlines()
    line = next(number for number, line in enumerate(lines, 1) if text in line)
    return f"{function} ({module.__file__}:{line})"


@pytest.mark.parametrize(
    ("innermost", "kind"),
    [
        (frame(fused_heads, "relu_layer", "y = torch.mm(x, w)"), "matrix products"),
        (frame(fused_heads, "relu_layer", "kernels.bias_relu("), "gates, biases, ReLUs"),
        (frame(rounded, "bf16", "low.copy_(weight.detach())"), "Adam, rounding"),
        (frame(client, "sample", "def sample("), "batches, priorities"),
        (frame(fused_heads, "_heads", "return out.reshape("), update_time.OTHER),
    ],
)
def test_a_stack_counts_as_what_its_innermost_line_does(innermost: str, kind: str) -> None:
    assert update_time.category(["<module> (/x/role.py:1)", "step (/x/learner.py:9)", innermost]) == kind


def test_what_an_outer_frame_says_goes_before() -> None:
    assert (
        update_time.category(["CompiledAdam.step (/x/optimizers.py:9)", "CompiledAdam._move (/x/optimizers.py:30)"])
        == "Adam, rounding"
    )
