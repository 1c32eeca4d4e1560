"""An episode of a policy as a video, rendered off screen."""

import inspect
import math
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from rmc.actors.evaluator import first_start, longest_episode
from rmc.analysis.out_file import check_writable
from rmc.analysis.policy import Policy
from rmc.analysis.rendering import PICTURE, choose_backend, rendered_frame
from rmc.common.env.config import EnvConfig
from rmc.common.env.faults import call_env
from rmc.common.env.make import make_env
from rmc.common.env.process_state import ApartCall
from rmc.common.env.registered import entry_point, find_spec
from rmc.common.env.wrappers import Env
from rmc.common.errors import ConfigError, EnvFault, RmcError, first_line
from rmc.common.extra import check_installed
from rmc.common.whole_file import written_whole

VIDEOS = (".mp4", ".mkv", ".mov", ".avi")  # that hold H.264
FRAMES_PER_SECOND = 30
MODE = "rgb_array"


def prepare(env: EnvConfig, out: Path) -> None:
    """See that an episode can be filmed, and choose what renders. Raises ConfigError, which says why not."""
    check_installed("video", ("imageio_ffmpeg",), "--video", str(out))
    check_writable("--video", out, VIDEOS)
    fault = _mode_fault(env)
    if fault is not None:
        raise ConfigError("--video", str(out), f"{env.id} cannot be filmed: {fault}")
    choose_backend(env, out)


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
        size = rendered_frame(env).shape
        rate = _frame_rate(env) / env_config.action_repeat  # a frame an action
        with written_whole(out) as path, _told(out):
            with closing(write_frames(str(path), (size[1], size[0]), fps=rate, macro_block_size=1)) as video:
                video.send(None)  # the generator's start
                for _ in range(min(longest, longest_episode(env))):
                    video.send(rendered_frame(env, size).tobytes())
                    action = policy.act(observation, info.get("missing", False))
                    observation, reward, terminated, truncated, info = env.step(action)
                    total += float(reward)
                    if terminated or truncated:
                        break
            count_frames_and_secs(str(path))  # ffmpeg does not say that it could not write the end
    return total


def _frame_rate(env: Env) -> float:
    """Of the environment's steps, by the second. Raises EnvFault where its metadata says something else."""
    said = env.metadata.get("render_fps")
    with suppress(TypeError, ValueError, OverflowError):
        if 0.0 < (rate := float(said or FRAMES_PER_SECOND)) < math.inf:
            return rate
    raise EnvFault(f'the environment\'s metadata["render_fps"] is {said!r}; give frames a second')


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
