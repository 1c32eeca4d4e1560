"""What matrix products are rounded to: bfloat16, TensorFloat-32, or nothing."""

import torch

from rmc.learner.config import Precision


def set_precision(precision: Precision, device: torch.device) -> bool:
    """Whether products there are in bfloat16, by autocast; those of a GPU's float32, the GRU's too, are set here.

    "auto" is what is fast: bfloat16 on a CPU that has it, TensorFloat-32 on a GPU, where bfloat16's casts cost kernels.
    """
    if device.type == "cuda":
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "auto"
    return precision == "bf16" or (precision == "auto" and has_fast_bf16(device))


def has_fast_bf16(device: torch.device) -> bool:
    """Whether bfloat16 products are much faster than float32's: on a CPU with AMX or AVX-512 BF16."""
    if device.type != "cpu":
        return False
    return bool(torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported())
