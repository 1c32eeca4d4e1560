"""What products are rounded to."""

import pytest
import torch

from rmc.learner.precision import set_precision


@pytest.fixture(autouse=True)
def flags_as_before():
    """The flags are the process's."""
    kept = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    yield
    torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = kept


@pytest.mark.parametrize(
    ("precision", "bf16", "tf32"), [("auto", False, True), ("bf16", True, False), ("fp32", False, False)]
)
def test_a_gpu_rounds_to_tensorfloat_where_that_is_left_to_us(precision, bf16, tf32):
    assert set_precision(precision, torch.device("cuda")) == bf16
    assert (torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32) == (tf32, tf32)


@pytest.mark.parametrize("fast", ["_is_amx_tile_supported", "_is_avx512_bf16_supported", None])
def test_a_cpu_takes_bfloat16_where_it_has_instructions_for_it(fast, monkeypatch):
    for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"):
        monkeypatch.setattr(torch.cpu, name, lambda name=name: name == fast)
    assert set_precision("auto", torch.device("cpu")) == (fast is not None)
    assert set_precision("bf16", torch.device("cpu"))
    assert not set_precision("fp32", torch.device("cpu"))
