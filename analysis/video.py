"""An episode of a policy as a video, rendered off screen."""

import dataclasses
import inspect
import json
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from rmc.actors.evaluator import first_start, longest_episode
from rmc.analysis.out_file import check_writable
from rmc.analysis.policy import Policy
from rmc.common.env.config import EnvConfig
from rmc.common.env.faults import call_env
from rmc.common.env.make import make_env
from rmc.common.env.process_state import ApartCall
from rmc.common.env.registered import entry_point, find_spec
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError, EnvFault, RmcError, first_line
from rmc.common.extra import check_installed
from rmc.common.process import descendants, watchdog
from rmc.common.whole_file import written_whole

VIDEOS = (".mp4", ".mkv", ".mov", ".avi")  # that hold H.264
BACKENDS = ("egl", "osmesa", "glfw")  # MuJoCo's, the ones that need no screen first
RENDERERS = {"mujoco", "OpenGL", "glfw", "dm_control"}  # packages, and gymnasium's folder of MuJoCo's environments
PROBE = "import sys; from rmc.analysis.video import probe; probe(*sys.argv[1:])"
PROBE_SECONDS = 60.0  # beside the time that the environment has to be made and to reset
FRAMES_PER_SECOND = 30
MODE, PICTURE = "rgb_array", "an array (height, width, 3) of uint8"
_own_choice = ""  # the backend that an earlier video has been given, where the user names none


def prepare(env: EnvConfig, out: Path) -> None:
    """See that an episode can be filmed, and choose what renders. Raises ConfigError, which says why not."""
    global _own_choice
    check_installed("video", ("imageio_ffmpeg",), "--video", str(out))
    check_writable("--video", out, VIDEOS)
    fault = _mode_fault(env)
    if fault is not None:
        raise ConfigError("--video", str(out), f"{env.id} cannot be filmed: {fault}")
    backend = _working_backend(env, out)
    if backend != os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = _own_choice = backend


def _mode_fault(env: EnvConfig) -> str | None:
    """Why an environment has no pictures, as far as it can be told without making it."""
    with ApartCall(env.id, "make", env.env_timeout):
        factory = call_env("entry point", lambda: entry_point(find_spec(env.id)))
    metadata = getattr(factory, "metadata", None)  # of a wrapper's class it is a property, and says nothing
    modes = metadata.get("render_modes") or [] if isinstance(metadata, dict) else []
    if isinstance(factory, type) and isinstance(metadata, dict) and MODE not in modes:
        return f'its metadata["render_modes"] is {modes}; give it "{MODE}", and a render() that returns {PICTURE}'
    try:
        inspect.signature(factory).bind_partial(render_mode=MODE)
    except TypeError:
        return f"it takes no render_mode; let its __init__ take and keep one, for a render() that returns {PICTURE}"
    except ValueError:  # of a class that is not written in Python
        return None
    return None


def record(policy: Policy, env_config: EnvConfig, seed: int, out: Path, longest: int = sys.maxsize) -> float:
    """Play one deterministic episode, ``longest`` steps of it at most, and write it to ``out``; its return.

    ``prepare`` must have been called. Raises EnvFault; RmcError where the file cannot be written.
    """
    from imageio_ffmpeg import count_frames_and_secs, write_frames  # an extra

    total = 0.0
    with closing(make_env(env_config, render=True)) as env:
        _follow(env)
        observation, info = env.reset(seed=first_start(seed, final=True))
        size = _frame(env).shape
        rate = (env.metadata.get("render_fps") or FRAMES_PER_SECOND) / env_config.action_repeat  # a frame an action
        with written_whole(out) as path, _told(out):
            with closing(write_frames(str(path), (size[1], size[0]), fps=rate, macro_block_size=1)) as video:
                video.send(None)  # the generator's start
                for _ in range(min(longest, longest_episode(env))):
                    video.send(_frame(env, size).tobytes())
                    action = policy.act(observation, info.get("missing", False))
                    observation, reward, terminated, truncated, info = env.step(action)
                    total += float(reward)
                    if terminated or truncated:
                        break
            count_frames_and_secs(str(path))  # ffmpeg does not say that it could not write the end
    return total


@contextmanager
def _told(out: Path) -> Iterator[None]:
    """What ffmpeg raises, with its own words of many lines, as one RmcError."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise RmcError(f"{out}: ffmpeg cannot write the video ({first_line(error)}); is the disk full?") from None


def _follow(env: Env) -> None:
    """Let a MuJoCo model's own tracking camera film, where it has one: gymnasium's stays where the body started."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is not None:
        import mujoco

        camera = mujoco.mj_name2id(renderer.model, mujoco.mjtObj.mjOBJ_CAMERA, "track")
        renderer.camera_id = camera if camera >= 0 else renderer.camera_id


def _frame(env: Env, shape: tuple[int, ...] | None = None) -> NDArray[np.uint8]:
    """(height, width, 3), both even, as the codec wants them. Raises EnvFault where it is no picture of that shape."""
    frame = np.asarray(env.render())
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8 or min(frame.shape) < 2:
        raise EnvFault(f"the environment's render gives {frame.dtype} of shape {frame.shape}; return {PICTURE}")
    frame = frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]
    if shape not in (None, frame.shape):
        raise EnvFault(f"the environment's render gives shape {frame.shape} after {shape}; keep one size")
    return frame


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
        _frame(environment)
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
