"""What another user sees of a run whose folders its owner has opened to all."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rmc.deploy.run.folder import RunFolder
from tests.deploy.test_attach import holder
from tests.deploy.test_folder import let_others_pass
from tests.runs import AGENTS, make_run

NOBODY = 65534
COLLEAGUE = """
import contextlib, io, os, sys
from rmc.cli.main import run
warm_up, words = sys.argv[1], sys.argv[2:]
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    run([words[0], warm_up, *words[2:]])  # imports what root alone may read
for left in os.listdir():
    os.unlink(left)
os.setgroups([])
os.setresgid(65534, 65534, 65534)
os.setresuid(65534, 65534, 65534)
sys.exit(run(words))
"""
pytestmark = pytest.mark.skipif(os.getuid() != 0, reason="only root can be somebody else")


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    run = make_run(tmp_path / "runs" / "run", AGENTS["robust"], "Pendulum-v1")
    record = {"role": "evaluator", "time": 1.0, "eval_update": 5, "eval_return_mean": 7.0, "eval_return_std": 1.0}
    run.metrics.write_text(json.dumps(record) + "\n")
    for path in (run.path, run.checkpoints, *run.checkpoints.glob("0*")):
        path.chmod(0o755)
    let_others_pass(tmp_path)
    (tmp_path / "home").mkdir()
    os.chown(tmp_path / "home", NOBODY, NOBODY)
    return run


@pytest.fixture
def training(folder: RunFolder) -> Iterator["subprocess.Popen[str]"]:
    with holder(folder, 130) as owner:
        yield owner
        if owner.poll() is None:
            owner.communicate("\n")


def as_nobody(folder: RunFolder, *words: str) -> "subprocess.Popen[str]":
    warm_up = "/nowhere" if words[0] in ("attach", "stop") else words[1]
    return subprocess.Popen(
        [sys.executable, "-c", COLLEAGUE, warm_up, *words],
        cwd=folder.path.parent.parent / "home",
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def said(process: "subprocess.Popen[str]") -> tuple[int, str, str]:
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


def test_they_may_look_at_it_while_it_is_trained(folder: RunFolder, training: "subprocess.Popen[str]") -> None:
    for words in (["list", str(folder.path.parent)], ["stats", str(folder.path)]):
        status, out, err = said(as_nobody(folder, *words))
        assert (status, err) == (0, "")
        assert "training" in out
    status, out, err = said(as_nobody(folder, "report", str(folder.path), "--no-video", "--out", "report.html"))
    assert status == 0, err


def test_they_may_watch_it_to_its_end(folder: RunFolder, training: "subprocess.Popen[str]") -> None:
    with as_nobody(folder, "attach", str(folder.path)) as watching:
        assert watching.stdout is not None
        assert watching.stdout.readline().startswith("0% | ")
        assert watching.poll() is None
        training.communicate("\n")
        status, out, _ = said(watching)
    assert status == 130
    assert "rmc resume" in out


def test_they_are_told_whose_it_is_when_they_stop_it(folder: RunFolder, training: "subprocess.Popen[str]") -> None:
    status, out, err = said(as_nobody(folder, "stop", str(folder.path)))
    line = f"rmc: RUN='{folder.path}': is trained by root (process {training.pid}); only they can stop it, or root\n"
    assert (status, out, err) == (2, "", line)


def test_where_its_lock_is_its_owners_alone_its_state_is_unknown(folder: RunFolder) -> None:
    """As versions before made it."""
    (folder.path / ".lock").chmod(0o600)
    for words in (["list", str(folder.path.parent)], ["stats", str(folder.path)]):
        status, out, err = said(as_nobody(folder, *words))
        assert (status, err) == (0, "")
        assert "unknown" in out
    status, _, err = said(as_nobody(folder, "stop", str(folder.path)))
    assert (status, err) == (2, f"rmc: {folder.path}/.lock: Permission denied; give another, or its rights\n")
