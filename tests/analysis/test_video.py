"""rmc evaluate --video and its grid of flicker probabilities, as a user runs them."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from imageio_ffmpeg import count_frames_and_secs, get_ffmpeg_exe

from rmc.analysis import rendering, video
from rmc.analysis.policy import load_policy
from rmc.analysis.video import _follow
from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.errors import ConfigError, EnvFault, RmcError
from rmc.common.whole_file import temporary_path
from tests.command import complaint, rmc
from tests.habits import Draws
from tests.runs import AGENTS, make_run

MOVES = """
import os
import gymnasium, torch
from tests.habits import Draws
print("a banner", flush=True)
os.chdir("/")
torch.set_default_dtype(torch.float64)
gymnasium.register("Moves-v0", Draws)
"""


@pytest.fixture(autouse=True)
def chosen_backend(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a video's test chooses to draw with is no other test's."""
    before = os.environ.get("MUJOCO_GL")
    monkeypatch.setattr(rendering, "_own_choice", "")
    yield
    monkeypatch.undo()
    os.environ.pop("MUJOCO_GL", None)
    if before is not None:
        os.environ["MUJOCO_GL"] = before


def evaluate(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """In a process of its own: rendering leaves traces in one."""
    return rmc("evaluate", str(folder), "--episodes", "1", *words, timeout=170)


def test_a_video_or_a_line_that_says_why_not(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5").path
    done = evaluate(folder, "--video", str(tmp_path / "episode.mp4"))
    if done.returncode == 2:  # a machine without EGL, OSMesa and screen
        assert "nothing here can render (egl: " in done.stderr
        assert len(done.stderr.splitlines()) == 1
        pytest.skip(done.stderr)
    assert (done.returncode, done.stderr) == (0, "")
    assert "episode.mp4: an episode with return" in done.stdout
    command = [get_ffmpeg_exe(), "-v", "error", "-i", str(tmp_path / "episode.mp4"), "-f", "framemd5", "-"]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert "#dimensions 0: 480x480" in lines
    images = [line.split(",")[-1] for line in lines if not line.startswith("#")]
    assert 1 < len(set(images)) <= 1000


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a pipe that imageio leaves open
@pytest.mark.parametrize("steps", [3, 400])
def test_a_video_that_cannot_be_written_is_one_line_and_none_is_left(steps: int, tmp_path: Path) -> None:
    """A short one fills no pipe: ffmpeg fails when all is sent."""
    config = EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "noise"})
    policy = load_policy(make_run(tmp_path / "run", AGENTS["robust"], config.id, env_kwargs=config.env_kwargs).path)
    out = tmp_path / "episode.mp4"
    temporary_path(out).symlink_to("/dev/full")
    with pytest.raises(RmcError, match=r"episode\.mp4: ffmpeg cannot write the video \(.*\); is the disk full\?$"):
        video.record(policy, config, 0, out, steps)
    assert not out.exists()


def frames(video_file: Path) -> tuple[int, float]:
    """How many, and how long they last."""
    return count_frames_and_secs(str(video_file))


def test_it_lasts_as_long_as_the_episode_whatever_is_repeated(tmp_path: Path) -> None:
    for repeat, length in ((1, 12), (4, 3)):
        config = EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "sound"}, action_repeat=repeat)
        folder = make_run(tmp_path / f"{repeat}", AGENTS["robust"], config.id, env_kwargs=config.env_kwargs)
        policy, out = load_policy(folder.path), tmp_path / f"{repeat}.mp4"
        video.record(policy, config, 0, out, length)
        assert frames(out) == (length, pytest.approx(1.2, abs=0.1))


@pytest.mark.parametrize("said", [None, 0, "25", np.float32(12.5), "fast", -5, np.nan, np.inf, [30]], ids=str)
def test_frames_a_second_are_a_positive_number_or_a_line(said: Any, tmp_path: Path, monkeypatch) -> None:
    config = EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "sound"})
    folder = make_run(tmp_path / "run", AGENTS["robust"], config.id, env_kwargs=config.env_kwargs)
    policy, out = load_policy(folder.path), tmp_path / "film.mp4"
    monkeypatch.setitem(Draws.metadata, "render_fps", said)
    if said in (None, 0, "25", 12.5):
        video.record(policy, config, 0, out)
        assert frames(out) == (12, pytest.approx(12 / float(said or 30), abs=0.1))
    else:
        words = re.escape(f'the environment\'s metadata["render_fps"] is {said!r}; give frames a second')
        with pytest.raises(EnvFault, match=f"^{words}$"):
            video.record(policy, config, 0, out)
        assert not out.exists()


def test_one_with_a_limit_is_filmed_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmc.actors.evaluator.LONGEST_EPISODE", 5)
    for limit, length in ((0, 5), (8, 8)):
        config = EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "sound"}, time_limit=limit)
        folder = make_run(tmp_path / f"{limit}", AGENTS["robust"], config.id, env_kwargs=config.env_kwargs)
        video.record(load_policy(folder.path), config, 0, tmp_path / "film.mp4")
        assert frames(tmp_path / "film.mp4")[0] == length


def test_what_a_module_does_as_it_is_imported_is_the_environments_alone(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "moves.py").write_text(MOVES)
    monkeypatch.syspath_prepend(tmp_path)
    make_run(tmp_path / "run", AGENTS["robust"], "moves:Moves-v0", env_kwargs={"picture": "sound"})
    words = ("evaluate", "run", "--episodes", "1", "--json", "--video", "film.mp4")
    done = rmc(*words, timeout=170, cwd=tmp_path, env={**os.environ, "PYTHONPATH": os.getcwd()})
    assert (done.returncode, done.stderr.splitlines()) == (0, ["a banner"])
    assert json.loads(done.stdout)["eval_episodes"] == 1
    assert (tmp_path / "film.mp4").exists()


def test_the_camera_follows() -> None:
    env = make_env(EnvConfig("HalfCheetah-v5"), render=True)
    _follow(env)
    assert env.unwrapped.mujoco_renderer.camera_id >= 0  # type: ignore[attr-defined]
    env.close()


def test_what_stands_in_the_way_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    folder = str(make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5").path)
    words = ["evaluate", folder, "--episodes", "1", "--video"]
    assert "its folder is not there" in complaint([*words, str(tmp_path / "no" / "episode.mp4")], capsys)
    assert "is a folder" in complaint([*words, str(tmp_path)], capsys)
    assert "ends in .mp4" in complaint([*words, str(tmp_path / "episode.txt")], capsys)
    timeout = complaint([*words, str(tmp_path / "episode.mp4"), "--env-timeout=-1"], capsys)
    assert "--env-timeout=-1.0: take a number from 0.1" in timeout
    link, behind = tmp_path / "link.mp4", tmp_path / "behind.mp4"
    link.symlink_to(behind)
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    complaint([*words, str(link)], capsys)
    assert link.is_symlink()
    assert not behind.exists()
    line = complaint([*words, str(tmp_path / "episode.mp4")], capsys)
    assert "nothing here can render (nonsense: " in line
    assert "libegl1 or libosmesa6" in line


def test_a_backend_that_hangs_is_passed_over_and_named(tmp_path: Path, capsys, monkeypatch) -> None:
    folder = str(make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5").path)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering, "PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(rendering, "PROBE_SECONDS", 0.2)
    out = tmp_path / "episode.mp4"
    words = ["evaluate", folder, "--episodes", "1", "--video", str(out), "--env-timeout", "0.1"]
    line = complaint(words, capsys)
    assert f"--video={str(out)!r}: nothing here can render (egl: no frame in 0.4 s; osmesa: no frame in 0.4 s" in line
    assert "libegl1 or libosmesa6" in line


def test_what_was_chosen_for_one_video_is_not_taken_for_the_users_choice(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)

    def probed(backend: str, env: EnvConfig) -> tuple[int, str]:
        return int(env.id == "HalfCheetah-v5" and backend != "osmesa"), "no display"

    monkeypatch.setattr(rendering, "_probed", probed)
    for env, backend in (("Pendulum-v1", "egl"), ("HalfCheetah-v5", "osmesa")):
        video.prepare(EnvConfig(env), tmp_path / "episode.mp4")
        assert os.environ["MUJOCO_GL"] == backend
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    for _ in range(2):  # which is the user's
        video.prepare(EnvConfig("Pendulum-v1"), tmp_path / "episode.mp4")
        assert os.environ["MUJOCO_GL"] == "glfw"


def test_a_grid_of_flicker(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(make_run(tmp_path / "run", AGENTS["robust"], "InvertedPendulum-v5").path)
    assert main.run(["evaluate", folder, "--episodes", "2", "--flicker", "0", "0.5", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert "missing" not in lines[0]
    assert "with 50% of the frames missing: return" in lines[1]
    assert "with 100% of the frames missing: return" in lines[2]
    assert "--flicker=2.0" in complaint(["evaluate", folder, "--flicker", "0", "2"], capsys)


@pytest.mark.parametrize(
    ("env", "kwargs", "says"),
    [
        ("Slide", {}, 'cannot be filmed: its metadata["render_modes"] is []; give it "rgb_array", and a render()'),
        ("TakesNoMode", {}, "cannot be filmed: it takes no render_mode; let its __init__ take and keep one"),
        ("Draws", {"picture": "none"}, "render gives object of shape (); return an array (height, width, 3) of uint8"),
        ("Draws", {"picture": "floats"}, "render gives float64 of shape (32, 40, 3); return an array"),
        ("Draws", {"picture": "list"}, "render gives uint8 of shape (1, 32, 40, 3); return an array"),
        ("Draws", {"picture": "with alpha"}, "render gives uint8 of shape (32, 40, 4); return an array"),
        (
            "Draws",
            {"picture": "raises"},
            "cannot be filmed: the environment's render raises KeyError: 'raises' (habits.py,",
        ),
    ],
)
def test_an_environment_without_pictures_is_named_before_anything_is_played(
    env: str, kwargs: dict[str, Any], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    folder = make_run(tmp_path / "run", AGENTS["robust"], f"tests.habits:{env}-v0", env_kwargs=kwargs).path
    monkeypatch.setenv("MUJOCO_GL", "egl")
    line = complaint(["evaluate", str(folder), "--video", str(tmp_path / "episode.mp4")], capsys)
    assert says in line
    assert "libegl1" not in line
    assert not (tmp_path / "episode.mp4").exists()


def test_a_wrappers_class_is_judged_by_what_it_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    video.prepare(EnvConfig("tests.habits:Masked-v0"), tmp_path / "episode.mp4")


def test_a_reset_that_hangs_is_named_within_the_environments_time(tmp_path: Path, capsys, monkeypatch) -> None:
    """With the driver that is asked for, and no other is tried."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    env = EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "sound", "late": 60.0}, env_timeout=1.0)
    begun = time.monotonic()
    with pytest.raises(ConfigError, match=r"cannot be filmed: ENV=.*: reset has not returned for 1 s \(habits.py"):
        video.prepare(env, tmp_path / "episode.mp4")
    assert time.monotonic() - begun < 30.0


def test_a_simulator_of_the_environments_ends_with_the_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is its standard error waited for."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    mark = f"{time.time():.6f}"  # seconds: told from other sleeps
    words = ["sh", "-c", f"touch {tmp_path}/began; exec sleep 1{mark}"]
    env = EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "sound", "simulator": words}, env_timeout=30.0)
    begun = time.monotonic()
    video.prepare(env, tmp_path / "episode.mp4")
    assert time.monotonic() - begun < 30.0
    assert (tmp_path / "began").exists()
    assert not [one for one in psutil.process_iter(["cmdline"]) if mark in " ".join(one.info["cmdline"] or [])]


def test_a_file_of_rmcs_name_in_the_working_folder_is_not_taken(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "rmc.py").write_text("raise SystemExit('shadowed')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    video.prepare(EnvConfig("tests.habits:Draws-v0", env_kwargs={"picture": "sound"}), tmp_path / "episode.mp4")


def test_an_environment_of_ones_own_is_filmed_without_a_screen(tmp_path: Path, monkeypatch) -> None:
    kwargs = {"picture": "sound"}
    folder = make_run(tmp_path / "run", AGENTS["robust"], "tests.habits:Draws-v0", env_kwargs=kwargs).path
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    done = evaluate(folder, "--video", str(tmp_path / "episode.mp4"))
    assert (done.returncode, done.stderr) == (0, "")
    assert "episode.mp4: an episode with return" in done.stdout
