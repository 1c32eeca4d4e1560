"""Gaussian noise whose neighbours in time are alike."""

import numpy as np
from numpy.typing import NDArray


class ColoredNoise:
    """Unit normal noise for N environments whose power falls as 1 / f^color; 0 is white, 1 is pink.

    Eberhard et al., "Pink noise is all you need", 2023. Each environment has a series of ``steps``; after it, another.
    """

    def __init__(self, envs: int, action_dim: int, color: float, rng: np.random.Generator, steps: int = 1000) -> None:
        self._color, self._rng, self._steps = color, rng, steps
        self._series = np.empty((envs, action_dim, steps), np.float32)
        self._at = np.zeros(envs, np.int64)
        for env in range(envs):
            self.restart(env)

    def restart(self, env: int) -> None:
        """Another series for this environment."""
        size = np.fft.rfftfreq(self._steps)
        size[0] = size[1]
        size = size ** (-self._color / 2)
        size[0] = 0.0
        spectrum = size * (self._rng.standard_normal((2, *self._series.shape[1:2], len(size))).T @ np.array([1, 1j])).T
        series = np.fft.irfft(spectrum, self._steps)
        power = np.sqrt(2 * (size[1:-1] ** 2).sum() * 2 + size[-1] ** 2) / self._steps
        self._series[env] = series / power
        self._at[env] = 0

    def __call__(self) -> NDArray[np.float32]:
        """(N, A), the next step's."""
        for env in np.flatnonzero(self._at == self._steps).tolist():
            self.restart(env)
        noise: NDArray[np.float32] = self._series[np.arange(len(self._at)), :, self._at]
        self._at += 1
        return noise
