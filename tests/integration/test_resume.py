"""The command that a stopped run prints continues it, typed as it is printed; what it changes counts from there."""

import itertools
import json
import os
import re
import shlex

import pytest
import torch

from rmc.common.checkpoint import CheckpointFolder
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.migrations import FORMAT
from rmc.deploy.run.starts import starts
from rmc.replay_server.recovery import open_store
from tests.command import rmc
from tests.docs.running import ran
from tests.integration.running import ENVIRONMENT, Training

SIZES = "--hidden 16 --embedding 16 --heads 16 16 --actors 2 --replay-ratio 8".split()  # noqa: SIM905
STEPS = {"local": 8_000, "lockstep": 4_000}  # more than there are when Ctrl-C comes


def drawn_steps(folder: RunFolder) -> int:
    """Trained steps that were drawn from the run's ring."""
    config = folder.config()
    store = open_store(folder.path / "replay", config.window_spec(), config.replay.capacity, 0.0)
    store.close()
    return store.ring.progress.drawn_steps


@pytest.mark.timeout(400)
@pytest.mark.parametrize("launcher", [pytest.param("local", marks=pytest.mark.long), "lockstep"])
def test_the_printed_command_goes_on(launcher, tmp_path):
    folder, steps = tmp_path / "a run", STEPS[launcher]
    with Training(folder, *SIZES, "--total-steps", str(steps), "--launcher", launcher) as training:
        training.wait_for_updates()
        training.interrupt()
        (printed,) = re.findall(r"to go on:\n\s+(rmc .*)\n", training.text())
    config = RunFolder(folder).config()
    assert printed == f"rmc resume '{folder}'"
    path = os.pathsep.join([os.getcwd(), os.environ.get("PYTHONPATH", "")])
    done = rmc(*shlex.split(printed)[1:], cwd=tmp_path, env={**ENVIRONMENT, "PYTHONPATH": path}, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    result = RunFolder(folder).result()
    assert steps <= result["env_steps"] < steps + 2 * config.slack_steps()
    assert RunFolder(folder).config() == config
    assert [start.changes for start in starts(RunFolder(folder))] == [{}, {}]
    assert {start.launch["launcher"] for start in starts(RunFolder(folder))} == {launcher}


@pytest.mark.timeout(400)
def test_a_changed_ratio_and_rate_count_from_there(tmp_path):
    """In a run: neither more updates for what was, nor none until the old ones are used up."""
    folder = tmp_path / "run"
    start = f"rmc train InvertedPendulum-v5 --preset debug --launcher lockstep --run-dir {folder} --total-steps 1500"
    drawn = []
    for command in (
        f"{start} --replay-ratio 32 --hidden 16 --embedding 16 --heads 16 16",
        f"rmc resume {folder} --total-steps 2500 --replay-ratio 4 --learning-rate 1e-5",
        f"rmc resume {folder} --total-steps 3500",
        f"rmc train --run-dir {folder} --total-steps 4500 --replay-ratio 16",
    ):
        ran(tmp_path, *shlex.split(command)[1:])
        drawn.append(drawn_steps(RunFolder(folder)))
    config = RunFolder(folder).config()
    assert (config.total_steps, config.replay.replay_ratio, config.update.learning_rate) == (4_500, 16.0, 1e-5)
    batch, slack = 16 * 15, config.slack_steps()
    more = [after - before for before, after in itertools.pairwise(drawn)]
    for steps, ratio in zip(more, (4, 4, 16), strict=True):
        assert 1_000 * ratio - batch - 2 * slack * ratio <= steps <= (1_000 + 2 * slack) * ratio + batch, more
    _, files = CheckpointFolder(folder / "checkpoints").latest()
    (folder / "state").write_bytes(files["learner.pt"])
    state = torch.load(folder / "state", weights_only=True)
    rates = [group["lr"] for optimizer in state["optimizers"] for group in optimizer["param_groups"]]
    assert rates == [1e-5, 1e-5, 1e-5, 3e-4]  # memory, world model; critics and policy, temperature
    output = ran(tmp_path, "stats", str(folder))
    assert "4 starts; from step 1,5" in output
    assert "--replay-ratio 32 to 4, --learning-rate 0.0003 to 1e-05" in output
    assert json.loads((folder / "config.json").read_text())["format"] == FORMAT
