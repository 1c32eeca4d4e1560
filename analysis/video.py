"""An episode of a policy as a video, rendered off screen."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rmc.actors.evaluator import LONGEST_EPISODE
from rmc.analysis.policy import Policy
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError
from rmc.common.extra import how_to_install
from rmc.deploy.run.folder import check_writable

VIDEOS = (".mp4", ".mkv", ".mov", ".avi", ".webm")
BACKENDS = ("egl", "osmesa", "glfw")  # MuJoCo's, the ones that need no screen first
PROBE = "import sys; from rmc.analysis.video import probe; probe(sys.argv[1])"
PROBE_SECONDS = 60
FRAMES_PER_SECOND = 30


def record(policy: Policy, env_config: EnvConfig, seed: int, out: Path) -> float:
    """Play one deterministic episode and write it to ``out``; its return. Raises ConfigError, before it plays."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise ConfigError("--video", str(out), f"imageio-ffmpeg is missing; {how_to_install('video')}")
    check_writable("--video", out, VIDEOS)
    os.environ["MUJOCO_GL"] = _working_backend(env_config, out)
    from imageio_ffmpeg import write_frames  # an extra

    env = make_env(env_config, render=True)
    _follow(env)
    observation, info = env.reset(seed=seed)
    frame, rate = _frame(env), env.metadata.get("render_fps", FRAMES_PER_SECOND)
    video = write_frames(str(out), (frame.shape[1], frame.shape[0]), fps=rate, macro_block_size=1)
    video.send(None)  # the generator's start
    total = 0.0
    for _ in range(LONGEST_EPISODE):
        video.send(_frame(env).tobytes())
        action = policy.act(observation, bool(info.get("missing", False)))
        observation, reward, terminated, truncated, info = env.step(action)
        total += float(reward)
        if terminated or truncated:
            break
    video.close()
    env.close()
    return total


def _follow(env: Env) -> None:
    """Let a MuJoCo model's own tracking camera film, where it has one: gymnasium's stays where the body started."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is not None:
        import mujoco

        camera = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
        renderer.camera_id = camera if camera >= 0 else renderer.camera_id


def _frame(env: Env) -> NDArray[np.uint8]:
    """(height, width, 3), both even, as the codec wants them."""
    frame = np.asarray(env.render(), np.uint8)
    return frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]


def _working_backend(env: EnvConfig, out: Path) -> str:
    """The first backend that renders, tried in processes of their own: a failed one spoils a process for others."""
    asked = os.environ.get("MUJOCO_GL")
    said = {}
    for backend in (asked,) if asked else BACKENDS:
        fault = _fault(backend, env)
        if fault is None:
            return backend
        said[backend] = fault
    reasons = "; ".join(f"{backend}: {reason}" for backend, reason in said.items())
    raise ConfigError("--video", str(out), f"nothing here can render ({reasons}); install libegl1 or libosmesa6")


def _fault(backend: str, env: EnvConfig) -> str | None:
    """Why a backend renders nothing, in a line; None where it does."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", PROBE, env.id],
            env={**os.environ, "MUJOCO_GL": backend, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True, text=True, timeout=PROBE_SECONDS, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:  # a driver that hangs
        return f"no frame in {PROBE_SECONDS} s"
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no reason given"])[-1]


def probe(env_id: str) -> None:
    """Render one frame. Raises whatever stands in the way."""
    env = make_env(EnvConfig(env_id), render=True)
    env.reset(seed=0)
    if env.render() is None:
        raise RuntimeError("it renders nothing")
