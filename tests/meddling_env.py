"""An environment that changes its whole process, and says in ``info`` how it finds it. Nothing of ours may notice."""

import io
import logging
import logging.config
import os
import random
import signal
import sys
import tempfile
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from tests.counting_env import CountingEnv


def nobody(*_: object) -> None:
    """Catches a signal, and lets it go."""


HABITS = {
    "folder": lambda: os.chdir(tempfile.gettempdir()),
    "numpy_errors": lambda: np.seterr(all="raise"),
    "dtype": lambda: torch.set_default_dtype(torch.float64),
    "gradients": lambda: torch.set_grad_enabled(False),
    "threads": lambda: torch.set_num_threads(3),
    "device": lambda: torch.set_default_device("meta"),
    "handlers": lambda: [signal.signal(number, nobody) for number in (signal.SIGINT, signal.SIGTERM)],
    "streams": lambda: setattr(sys, "stdout", io.StringIO()) or setattr(sys, "stderr", io.StringIO()),
    "logs": lambda: logging.config.dictConfig({"version": 1, "root": {"level": "ERROR"}}),
    "random": lambda: (np.random.seed(1), random.seed(1), torch.manual_seed(1)),  # noqa: NPY002
}


def as_it_is() -> tuple[Any, ...]:
    return (
        os.getcwd(), np.geterr(), torch.get_default_dtype(), torch.is_grad_enabled(), torch.get_num_threads(),
        torch.get_default_device(),
    )  # fmt: skip


class MeddlingEnv(CountingEnv):
    """Has its habits when it is made or, with ``late``, in each reset."""

    def __init__(self, habits: tuple[str, ...] = tuple(HABITS), late: bool = False) -> None:
        super().__init__()
        self._habits, self._late = habits, late
        if not late:
            self._meddle()

    def _meddle(self) -> None:
        for name in self._habits:
            HABITS[name]()
        self.left = as_it_is()

    def reset(self, **given: Any) -> tuple[np.ndarray, dict[str, Any]]:
        if self._late:
            self._meddle()
        assert as_it_is() == self.left
        return super().reset(**given)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert as_it_is() == self.left
        return super().step(action)


for _name in HABITS:
    for _late in (False, True):
        gym.register(
            f"Meddling-{_name}-{'late' if _late else 'early'}-v0",
            MeddlingEnv,
            kwargs={"habits": (_name,), "late": _late},
        )
gym.register("Meddling-v0", MeddlingEnv)
