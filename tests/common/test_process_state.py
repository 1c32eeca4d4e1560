"""What an environment changes of its process is its own: our code finds the process as it was."""

import io
import os
import signal
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.common.env.make import make_env
from rmc.common.env.process_state import ApartCall, ProcessState, torch_as_imported
from rmc.learner.precision import set_precision
from tests import meddling_env
from tests.command import complaint, rmc
from tests.counting_env import CountingEnv


@pytest.mark.parametrize("when", ["early", "late"])
@pytest.mark.parametrize("habit", meddling_env.HABITS)
def test_both_find_the_process_as_they_left_it(habit: str, when: str) -> None:
    before = ProcessState.read(), meddling_env.as_it_is()
    env = make_env(EnvConfig(f"tests.meddling_env:Meddling-{habit}-{when}-v0"))
    for seed in range(2):
        env.reset(seed=seed)
        assert (ProcessState.read(), meddling_env.as_it_is()) == before
        env.step(np.zeros(2, np.float32))  # it asserts that it finds its own
        assert (ProcessState.read(), meddling_env.as_it_is()) == before
    env.close()
    assert (ProcessState.read(), meddling_env.as_it_is()) == before


def test_how_a_child_ended_is_known_whatever_an_environment_ignores() -> None:
    pipes = signal.getsignal(signal.SIGPIPE)
    with ApartCall("Mine-v0", "reset", 1.0):
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    assert subprocess.run(["false"], check=False).returncode == 1
    assert signal.getsignal(signal.SIGPIPE) == pipes


def test_a_refusal_is_printed_whatever_its_module_does_with_the_streams(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "quiet.py").write_text(
        "import io, sys, gymnasium\nsys.stdout = sys.stderr = io.StringIO()\n"
        "from gymnasium.envs.classic_control import CartPoleEnv\ngymnasium.register('Quiet-v0', CartPoleEnv)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert "actions are Discrete" in complaint(["check-env", "quiet:Quiet-v0"], capsys)


def test_what_another_thread_writes_to_is_not_taken_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """A program may redirect its output while another of its threads plays."""
    monkeypatch.setattr("sys.stdout", sys.stdout)
    begun, redirected, theirs = threading.Event(), threading.Event(), io.StringIO()

    def play() -> None:
        with ApartCall("Mine-v0", "reset", 60.0):
            begun.set()
            redirected.wait()

    with ThreadPoolExecutor(1) as pool:
        played = pool.submit(play)
        begun.wait()
        sys.stdout = theirs
        redirected.set()
        played.result()
    assert sys.stdout is theirs


def test_what_one_environment_has_changed_another_does_not_find() -> None:
    make_env(EnvConfig("tests.meddling_env:Meddling-dtype-early-v0")).close()
    with ApartCall("Other-v0", "make", 1.0):
        assert torch.get_default_dtype() == torch.float32
    with ApartCall("tests.meddling_env:Meddling-dtype-early-v0", "reset", 1.0):
        assert torch.get_default_dtype() == torch.float64


def test_what_a_module_changes_all_its_environments_find() -> None:
    """Its import, which no second environment repeats, may do so."""
    make_env(EnvConfig("tests.meddling_env:Meddling-dtype-early-v0")).close()
    with ApartCall("tests.meddling_env:Meddling-folder-late-v0", "make", 1.0):
        assert torch.get_default_dtype() == torch.float64


def test_a_callers_rounding_stays_where_no_gpu_learns() -> None:
    torch.set_float32_matmul_precision("medium")
    try:
        with torch_as_imported():
            set_precision("auto", torch.device("cpu"))
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision("highest")


def test_a_callers_rounding_comes_back_where_a_gpu_learned() -> None:
    for precision in ("highest", "medium"):
        torch.set_float32_matmul_precision(precision)
        try:
            with torch_as_imported():
                set_precision("auto", torch.device("cuda"))
                assert torch.backends.cuda.matmul.allow_tf32
            assert torch.get_float32_matmul_precision() == precision
        finally:
            torch.set_float32_matmul_precision("highest")


def test_what_other_threads_change_meanwhile_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(".")  # back at the end
    monkeypatch.setattr("sys.stdout", sys.stdout)
    theirs = io.StringIO()
    with torch_as_imported(), ThreadPoolExecutor(1) as other:
        other.submit(os.chdir, tmp_path).result()
        other.submit(torch.set_default_dtype, torch.float64).result()
        other.submit(setattr, sys, "stdout", theirs).result()
    try:
        assert (os.getcwd(), torch.get_default_dtype(), sys.stdout) == (str(tmp_path), torch.float64, theirs)
    finally:
        torch.set_default_dtype(torch.float32)


def test_of_two_at_once_the_last_gives_the_callers_dtype_back() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        first, second = torch_as_imported(), torch_as_imported()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float32
        second.__exit__(None, None, None)
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)


def test_of_two_at_once_both_give_the_callers_threads_back() -> None:
    """Though the second begins while the first plays, with one."""
    torch.set_num_threads(2)
    try:
        first, second = torch_as_imported(), torch_as_imported()
        first.__enter__()
        torch.set_num_threads(1)
        second.__enter__()
        first.__exit__(None, None, None)
        torch.set_num_threads(1)
        second.__exit__(None, None, None)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)


class Homeless(CountingEnv):
    """Its working folder is deleted under it."""

    def __init__(self) -> None:
        super().__init__()
        folder = tempfile.mkdtemp()
        os.chdir(folder)
        os.rmdir(folder)


gym.register("Homeless-v0", Homeless)


def test_a_folder_that_is_gone_harms_nobody() -> None:
    before = os.getcwd()
    env = make_env(EnvConfig("Homeless-v0"))
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    env.close()
    assert os.getcwd() == before


def test_check_env_names_what_is_changed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["check-env", "tests.meddling_env:Meddling-v0", "--steps", "50"]) == 0
    output = capsys.readouterr().out
    for words in (
        "note: it changes", "torch's default dtype (torch.float64)", "torch's grad mode (False)",
        "the working folder (/",
        "torch's threads (3)", "numpy's error state", "torch's default device (meta)", "the handlers of signals",
        "sys.stdout and sys.stderr", "the setup of logging", "the random generators that all share",
    ):  # fmt: skip
        assert words in output
    ApartCall.changed, ApartCall.env_states = {}, {}
    main.run(["check-env", "tests.counting_env:Counting-v0", "--steps", "50"])
    assert "it changes" not in capsys.readouterr().out


MODULE = """
from tests.meddling_env import HABITS, MeddlingEnv
import gymnasium as gym
for habit in HABITS.values():
    habit()
gym.register("Mine-v0", MeddlingEnv, max_episode_steps=20)
"""


@pytest.mark.parametrize("launcher", [pytest.param("local", marks=pytest.mark.long), "lockstep"])
def test_training_does_not_notice(tmp_path: Path, launcher: str) -> None:
    """The module lies where the command is started, and meddles when it is imported, too; the run's folder is there."""
    (tmp_path / "mine.py").write_text(MODULE)
    words = ["train", "mine:Mine-v0", "--preset", "debug", "--run-dir", "run", "--launcher", launcher]
    words += ["--total-steps", "700", "--checkpoint-steps", "600"]
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "RMC_SECRET": ""}
    done = rmc(*words, cwd=tmp_path, env=environment, timeout=170)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "run" / "result.json").exists()
    if launcher == "lockstep":  # of the launcher, what plays knows nothing
        done = rmc("inspect", "run", "--out", "picture.png", cwd=tmp_path, env=environment, timeout=100)
        assert done.returncode == 0, done.stdout + done.stderr
        assert (tmp_path / "picture.png").exists()
