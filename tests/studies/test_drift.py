"""What is printed of h: shares of variance on real checkpoints, and the same ones where nothing has moved."""

import re
from pathlib import Path

import pytest
import torch

from rmc.cli import main
from rmc.common.checkpoint import CheckpointFolder
from studies import drift


def test_a_probe_finds_what_is_linear_and_nothing_else() -> None:
    x = torch.randn(400, 5, generator=torch.Generator().manual_seed(0))
    y = torch.cat([x @ torch.ones(5, 1) + 3.0, torch.randn(400, 1, generator=torch.Generator().manual_seed(1))], 1)
    linear, noise = drift.held_out_r2(x, y).tolist()
    assert linear > 0.999
    assert noise < 0.1


def test_a_run_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "train Pendulum-v1 --preset debug --launcher lockstep --total-steps 900 --checkpoint-steps 300 --episodes 1"
    assert main.run([*words.split(), "--run-dir", str(tmp_path / "run")]) == 0
    checkpoints = CheckpointFolder(tmp_path / "run" / "checkpoints", keep=99)
    newest = checkpoints.numbers()[-1]
    checkpoints.save(newest - 1, checkpoints.load(newest))  # as if nothing had moved since
    capsys.readouterr()
    drift.report(tmp_path / "run", 40)
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"run, \d+ windows, update [\d,]+", lines[0])
    assert re.fullmatch(r"  o: median -?\d+\.\d\d, worst dimensions (-?\d+\.\d\d(, )?)+", lines[1])
    assert len(lines) == len(checkpoints.numbers()) + 1
    assert lines[-1] == "  1 updates before: distance 0.00, h 1.00, Q 1.00, action 1.00"
    assert lines[-2] != lines[-1].replace("  1 ", lines[-2][:4])
