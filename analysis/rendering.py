"""What renders on this machine: MuJoCo's backends, each tried in a process of its own, which imports no torch."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import traceback
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError, EnvFault
from rmc.common.process import descendants, watchdog

BACKENDS = ("egl", "osmesa", "glfw")  # MuJoCo's, the ones that need no screen first
RENDERERS = {"mujoco", "OpenGL", "glfw", "dm_control"}  # packages, and gymnasium's folder of MuJoCo's environments
PROBE = "import sys; from rmc.analysis.rendering import probe; probe(*sys.argv[1:])"
PROBE_SECONDS = 60.0  # beside the time that the environment has to be made and to reset
PICTURE = "an array (height, width, 3) of uint8"
_own_choice = ""  # the backend that an earlier video has been given, where the user names none


def choose_backend(env: EnvConfig, out: Path) -> None:
    """Let MuJoCo render by what works here. Raises ConfigError where nothing does."""
    global _own_choice
    backend = _working_backend(env, out)
    if backend != os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = _own_choice = backend


def _working_backend(env: EnvConfig, out: Path) -> str:
    """The first backend that renders, tried in processes of their own: a failed one spoils a process for others."""
    chosen = os.environ.get("MUJOCO_GL")
    failures = {}
    for backend in (chosen,) if chosen and chosen != _own_choice else BACKENDS:
        status, words = _probed(backend, env)
        if status == 0:
            return backend
        if status == watchdog.HUNG_STATUS and ": render has not returned" not in words:  # a driver may hang in it
            raise ConfigError("--video", str(out), f"{env.id} cannot be filmed: {words}")
        failures[backend] = words
    reasons = "; ".join(f"{backend}: {reason}" for backend, reason in failures.items())
    raise ConfigError("--video", str(out), f"nothing here can render ({reasons}); install libegl1 or libosmesa6")


def _probed(backend: str, env: EnvConfig) -> tuple[int, str]:
    """How a process ended that rendered a frame with a backend, and the last line that it said."""
    seconds = PROBE_SECONDS + 2 * env.env_timeout
    words = [sys.executable, "-P", "-c", PROBE, json.dumps(dataclasses.asdict(env)), json.dumps(sys.path)]
    with tempfile.TemporaryFile() as said:  # of a pipe a simulator of the environment's would keep the other end
        process = subprocess.Popen(
            words, env=os.environ | {"MUJOCO_GL": backend}, stdin=subprocess.DEVNULL, stdout=said, stderr=said
        )
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:  # a driver that hangs
            return 1, f"no frame in {seconds:g} s"
        finally:
            if process.poll() is None:
                descendants.end(psutil.Process(process.pid))
                process.wait()
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
    return process.returncode, (lines or ["no reason given"])[-1].removeprefix("rmc: ")


def probe(env: str, import_path: str) -> None:
    """Render one frame of an environment, its config as JSON; ends the process where the environment is at fault.

    ``import_path`` is JSON, too: where the asking process finds modules. Raises whatever else stands in the way: what
    draws for it does not work here.
    """
    sys.path += [folder for folder in json.loads(import_path) if folder not in sys.path]
    descendants.adopt_orphans()
    watchdog.start()
    try:
        environment = make_env(EnvConfig(**json.loads(env)), render=True)
        environment.reset(seed=0)
        rendered_frame(environment)
        environment.close()
    except EnvFault as fault:
        if fault.__cause__ is not None and _is_renderers(fault.__cause__):
            raise fault.__cause__ from None
        sys.stderr.write(f"{fault}\n")
        sys.exit(watchdog.HUNG_STATUS)  # as of an environment that hangs
    finally:
        descendants.end_children()


def _is_renderers(error: BaseException) -> bool:
    """Whether an error comes from a library that draws, which another backend may help."""
    files = [Path(frame.f_code.co_filename).parts for frame, _ in traceback.walk_tb(error.__traceback__)]
    return any(set(parts) & RENDERERS and "site-packages" in parts for parts in files)


def rendered_frame(env: Env, shape: tuple[int, ...] | None = None) -> NDArray[np.uint8]:
    """(height, width, 3), both even, as the codec wants them. Raises EnvFault where it is no picture of that shape."""
    frame = np.asarray(env.render())
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8 or min(frame.shape) < 2:
        raise EnvFault(f"the environment's render gives {frame.dtype} of shape {frame.shape}; return {PICTURE}")
    frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
    if shape not in (None, frame.shape):
        raise EnvFault(f"the environment's render gives shape {frame.shape} after {shape}; keep one size")
    return frame
