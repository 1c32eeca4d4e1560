"""PyBullet's walkers that show their positions or their velocities alone: ``pybullet/AntPositions-v0`` and so on.

Importing this registers them; it takes the extra ``pybullet``. An observation of pybullet_envs_gymnasium
(``WalkerBase.calc_state``) is height, sine and cosine of the angle to the target; 3 velocities; roll and pitch; angle
and speed of each joint in turn; contacts of the feet. As in the tables of the field, a contact is a position.
"""

import importlib
import os
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rmc.common.process.redirect import redirected

ROBOTS = ("Ant", "HalfCheetah", "Hopper", "Walker2D")
PARTS = ("positions", "velocities")
Part = Literal["positions", "velocities"]
# pybullet's C code prints when it is loaded and when it connects, amid what a command prints as JSON.
NOWHERE = dict.fromkeys((1, 2), os.open(os.devnull, os.O_WRONLY))


class ShownPart(gym.ObservationWrapper[Any, Any, Any]):
    """A walker's positions, or its velocities."""

    def __init__(self, env: gym.Env[Any, Any], part: Part) -> None:
        super().__init__(env)
        assert env.observation_space.shape
        assert env.action_space.shape
        self._shown = shown_places(part, env.action_space.shape[0], env.observation_space.shape[0])
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, self._shown.shape, np.float32)

    def observation(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Of all numbers those that are shown."""
        return observation[self._shown]


def shown_places(part: Part, joints: int, size: int) -> NDArray[np.intp]:
    """Where the positions or the velocities stand among the numbers of an observation."""
    speeds = [3, 4, 5, *range(9, 8 + 2 * joints, 2)]
    return np.array(speeds) if part == "velocities" else np.setdiff1d(np.arange(size), speeds)


def make_walker(robot: str, part: Part, render_mode: str | None = None) -> ShownPart:
    """One of ``ROBOTS``, without a time limit."""
    envs = importlib.import_module("pybullet_envs_gymnasium.gym_locomotion_envs")
    env = getattr(envs, f"{robot}BulletEnv")(render_mode=render_mode)
    with redirected(NOWHERE):
        env.reset(seed=0)  # connects; later resets go back to the state of this one
    return ShownPart(env, part)


with redirected(NOWHERE):
    importlib.import_module("pybullet")
for _robot in ROBOTS:
    for _part in PARTS:
        gym.register(
            f"pybullet/{_robot}{_part.title()}-v0",
            f"{__name__}:make_walker",
            max_episode_steps=1000,
            kwargs={"robot": _robot, "part": _part},
        )
