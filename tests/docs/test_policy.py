"""The pages about policies: their commands and programs run as they are printed, one after the other."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rmc.analysis.policy import load_policy
from tests.analysis.hub_stub import Hub
from tests.docs.running import DOCS, LOCKSTEP, commands, ran

POLICY, HUB = (DOCS / "policy.md").read_text(), (DOCS / "hub.md").read_text()
ALONE = "import sys\nsys.modules |= dict.fromkeys(['torch', 'rmc', 'gymnasium', 'safetensors'])\n"
SHORTER = ["--total-steps", "700", *LOCKSTEP, "--episodes", "1"]


def python(*words: str, folder: Path, **more: str) -> str:
    """What it printed; it must have had nothing to complain about."""
    words = (sys.executable, *words)
    done = subprocess.run(words, cwd=folder, env=os.environ | more, capture_output=True, text=True, timeout=280)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    return done.stdout


@pytest.mark.timeout(300)
def test_the_pages_run(tmp_path: Path) -> None:
    for command in commands(POLICY):
        shorter = SHORTER * (command[0] == "train")
        ran(tmp_path, *command, *shorter)
    loop, batch, alone = re.findall(r"```python\n(.*?)```", POLICY, re.DOTALL)
    shown = "print(action.dtype, abs(action) <= 2, actions.shape, policy.header.eval_episodes)"
    assert python("-c", f"{loop}\n{batch}\n{shown}", folder=tmp_path) == "float32 [ True] (3, 1) 10\n"
    policy = load_policy(tmp_path / "policy.safetensors")
    (checkpoint,) = tmp_path.glob(re.findall(r"`(runs/.*policy.safetensors)`", POLICY)[0])
    shutil.copy(checkpoint, tmp_path / "copy.safetensors")
    copied = load_policy(tmp_path / "copy.safetensors")
    assert (copied.header.env_steps, copied.header.eval_return_mean) == (policy.header.env_steps, None)
    assert copied.act([1.0, 0.0, 0.5]) == policy.act([1.0, 0.0, 0.5])
    policy.reset()
    first = policy.act([1.0, 0.0, 0.5], units="environment")
    second = policy.act([0.0, 0.0, 0.0], missing=True, units="environment")
    ours = f"{alone}\nprint(act(start, [1.0, 0.0, 0.5])[0].round(4), action.round(4))"
    assert python("-c", ALONE + ours, folder=tmp_path) == f"{first.round(4)} {second.round(4)}\n"
    _share(tmp_path)


def _share(folder: Path) -> None:
    hub = Hub()
    named = hub.environment(folder / "home")
    try:
        both = f"from rmc.cli.main import run\nfor words in {commands(HUB)}: assert run(words) == 0"
        push, pull = python("-c", both, folder=folder, **named).splitlines()
        (code,) = re.findall(r"```python\n(.*?)```", HUB, re.DOTALL)
        loaded = python("-c", f"{code}\nprint(action.shape)", folder=folder, **named)
    finally:
        hub.close()
    assert push.startswith(f"{hub.url}/you/pendulum: Pendulum-v1 after ")
    assert pull.startswith("pulled.safetensors: Pendulum-v1 after ")
    assert loaded == "(1,)\n"


def test_they_are_short() -> None:
    assert all(len(page.splitlines()) <= 80 for page in (POLICY, HUB))
