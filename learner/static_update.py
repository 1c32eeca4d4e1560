"""The update on its device: rows in, priorities out, the batch always in the same memory.

That is what a CUDA graph asks for; a CPU takes the same way, without a graph. Shapes: B batch.
"""

import torch
from torch import Tensor

from rmc.common.window import WindowSpec
from rmc.learner.batch import view_batch
from rmc.learner.cuda_graph import CopiesAhead, CudaGraph
from rmc.learner.update import JointUpdate, Updated


class StaticUpdate:
    """An update of batches of one size. A checkpoint must be taken up before the first call, not after."""

    def __init__(self, update: JointUpdate, spec: WindowSpec, batch_size: int) -> None:
        device = update.agent.log_alpha.device
        self._update, self._spec = update, spec
        self._raw = torch.zeros(batch_size, spec.dtype.itemsize, dtype=torch.uint8, device=device)
        self._importance, self._beta = torch.ones(batch_size, device=device), torch.zeros((), device=device)
        self._work, self._copy, self.in_flight = self._once, self._copy_now, 0
        if device.type == "cuda":
            self._work = CudaGraph(self._once, update.generator)
            self._copy = CopiesAhead([self._raw, self._importance])
            self.in_flight = 1

    def __call__(self, raw: Tensor, importance: Tensor, beta: float) -> Updated:
        """(B, row bytes) uint8 without padding, (B,) float32. What it returns is overwritten by the next call.

        On a GPU this only launches. ``raw`` may be written again once the update's priorities are on the host.
        """
        self._copy([raw, importance])
        self._beta.fill_(beta)
        return self._work()

    def _once(self) -> Updated:
        return self._update(view_batch(self._raw, self._importance, self._spec), self._beta)

    def _copy_now(self, tensors: list[Tensor]) -> None:
        for place, tensor in zip((self._raw, self._importance), tensors, strict=True):
            place.copy_(tensor)
