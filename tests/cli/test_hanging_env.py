"""Every command has --env-timeout: it ends with a line that names the environment, the call, and how long it took."""

import os
import re
import time
from pathlib import Path

import pytest

from rmc.common.env.config import EnvConfig
from rmc.common.process.watchdog import HUNG_STATUS
from rmc.deploy.run.presets import debug
from tests.command import rmc
from tests.runs import run_of

ENV = "tests.hanging_env:HangsAsTold-v0"
LINE = r"rmc: ENV='{}': {} has not returned for {} s \(hanging_env\.py, line \d+\); fix it, or raise --env-timeout\n"


def check_ends(words: list[str], place: str, call: str, seconds: float) -> None:
    """Within a time that leaves room for slow imports."""
    began = time.monotonic()
    done = rmc(*words, env={**os.environ, "RMC_TEST_HANGS": place})
    assert re.fullmatch(LINE.format(re.escape(ENV), call, f"{seconds:g}"), done.stderr), done.stderr
    assert done.returncode == HUNG_STATUS
    assert time.monotonic() - began >= seconds


@pytest.mark.parametrize(
    ("place", "call"),
    [
        ("import", "make"), pytest.param("make", "make", marks=pytest.mark.long), ("step", "step"),
        pytest.param("reset", "reset", marks=pytest.mark.long), pytest.param("close", "close", marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_check_env(place: str, call: str) -> None:
    check_ends(["check-env", ENV, "--env-timeout", "1.5"], place, call, 1.5)


@pytest.mark.parametrize(
    "words", [("evaluate",), pytest.param(("evaluate", "--json"), marks=pytest.mark.long), ("inspect",)]
)
def test_what_plays_a_run_takes_the_runs(tmp_path: Path, words: tuple[str, ...]) -> None:
    folder = run_of(tmp_path / "run", debug(EnvConfig(ENV, env_timeout=2.0)))
    check_ends([words[0], str(folder.path), *words[1:]], "step", "step", 2)


@pytest.mark.parametrize("place", [pytest.param("reset", marks=pytest.mark.long), "step"])
def test_training_in_its_first_evaluation(tmp_path: Path, place: str) -> None:
    check_ends(["train", ENV, "--run-dir", str(tmp_path / "run"), "--env-timeout", "1"], place, place, 1)


def test_a_baseline(tmp_path: Path) -> None:
    check_ends(["baseline", "sac", ENV, "--run-dir", str(tmp_path / "run"), "--env-timeout", "1"], "step", "step", 1)
