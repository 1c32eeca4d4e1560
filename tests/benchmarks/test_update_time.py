"""What a sampled stack of the learner counts as."""

from pathlib import Path

import pytest

from benchmarks import update_time
from rmc.learner import fused


def line_of(text: str) -> int:
    lines = Path(fused.__file__).read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


@pytest.mark.parametrize(
    ("function", "text", "kind"),
    [
        ("_layer", "y = torch.mm(x, w)", "matrix products"),
        ("_layer", "kernels.bias_relu(", "gates, biases, ReLUs"),
        ("bf16", "low.copy_(weight.detach())", "Adam, rounding"),
        ("_heads", "return out.reshape(", update_time.OTHER),
    ],
)
def test_a_stack_counts_as_what_its_innermost_line_does(function: str, text: str, kind: str) -> None:
    innermost = f"{function} ({fused.__file__}:{line_of(text)})"
    assert update_time.category(["<module> (/x/role.py:1)", "step (/x/learner.py:9)", innermost]) == kind


def test_what_an_outer_frame_says_goes_before() -> None:
    assert (
        update_time.category(["CompiledAdam.step (/x/optimizers.py:9)", "CompiledAdam._move (/x/optimizers.py:30)"])
        == "Adam, rounding"
    )
