"""Sensors that fail one by one, in what ``rmc evaluate`` plays and tells."""

import json
from pathlib import Path

import pytest

from rmc.cli import main
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.presets import debug
from tests.runs import run_of


def test_a_policy_is_evaluated_with_its_sensors_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(tmp_path / "run", debug(EnvConfig("Pendulum-v1", drop_sensors=0.3))).path
    for what in (run, *run.glob("checkpoints/*/policy.safetensors")):
        assert main.run(["evaluate", str(what), "--episodes", "1", "--json"]) == 0
        played = json.loads(capsys.readouterr().out)
        assert (played["eval_drop_sensors"], played["eval_flicker"]) == (0.3, 0.0)
    assert main.run(["evaluate", str(run), "--episodes", "1", "--flicker", "0.2"]) == 0
    assert "Pendulum-v1 with 20% of the frames and 30% of the sensors missing: return" in capsys.readouterr().out
