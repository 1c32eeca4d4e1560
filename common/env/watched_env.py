"""An environment whose calls must return in time, where the process is watched, and change it for themselves alone."""

from typing import Any

import gymnasium as gym

from rmc.common.env.process_state import ApartCall


class WatchedEnv(gym.Wrapper[Any, Any, Any, Any]):
    """Says when a call begins and ends; see ``ApartCall`` and ``rmc.common.process.watchdog``."""

    def __init__(self, env: gym.Env[Any, Any], env_id: str, seconds: float) -> None:
        super().__init__(env)
        self._id, self._seconds = env_id, seconds

    def _call(self, name: str) -> ApartCall:
        return ApartCall(self._id, name, self._seconds)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        with self._call("reset"):
            return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        with self._call("step"):
            return self.env.step(action)

    def render(self) -> Any:
        with self._call("render"):
            return self.env.render()

    def close(self) -> None:
        with self._call("close"):
            self.env.close()
