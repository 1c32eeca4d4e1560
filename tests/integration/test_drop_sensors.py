"""Sensors that fail one by one, from the command line through every role."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.folder import RunFolder
from rmc.replay_server.recovery import open_store

TINY = "--preset debug --total-steps 1200 --warmup-steps 300 --batch-size 4 --replay-ratio 4 --checkpoint-steps 900"


@pytest.mark.timeout(300)
def test_a_run_trains_and_is_evaluated_with_sensors_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The flags of each dimension are in the ring, and its policy's file plays with the same option."""
    run, threads = tmp_path / "run", torch.get_num_threads()
    words = ["train", "Pendulum-v1", "--drop-sensors", "0.3", *TINY.split(), "--launcher", "lockstep"]
    try:
        assert main.run([*words, "--run-dir", str(run)]) == 0, capsys.readouterr().err
    finally:
        torch.set_num_threads(threads)
    capsys.readouterr()
    config = RunFolder(run).config()
    assert config.env == EnvConfig("Pendulum-v1", drop_sensors=0.3)
    store = open_store(run / "replay", config.window_spec(), config.replay.capacity, config.replay.priority_exponent)
    rows = store.ring.rows[: store.ring.progress.next_serial]
    steps = np.arange(rows["missing"].shape[1])
    real = (rows["first"][:, None] <= steps) & (steps <= rows["last"][:, None])
    missing = rows["missing"][real].astype(bool)
    assert missing.shape[1:] == (3,)
    assert missing.mean() == pytest.approx(0.3, abs=0.05)
    assert 0 < missing.all(1).mean() < 0.1  # each on its own
    np.testing.assert_array_equal(rows["observation"][real][missing], 0.0)
    store.close()
    for what in (run, sorted(run.glob("checkpoints/*/policy.safetensors"))[-1]):
        assert main.run(["evaluate", str(what), "--episodes", "1", "--json"]) == 0
        played = json.loads(capsys.readouterr().out)
        assert (played["eval_drop_sensors"], played["eval_flicker"]) == (0.3, 0.0)
    assert main.run(["evaluate", str(run), "--episodes", "1", "--flicker", "0.2"]) == 0
    assert "Pendulum-v1 with 20% of the frames and 30% of the sensors missing: return" in capsys.readouterr().out
    assert main.run(["inspect", str(run), "--out", str(tmp_path / "inspect.png")]) == 0
