"""The commands of docs/resume.md and docs/warm-start.md run as they are printed, and their tables are the code's."""

import dataclasses
import functools
import json
import re
from pathlib import Path
from typing import get_args

import pytest

import rmc
from rmc import presets
from rmc.analysis.baselines import MAY_CHANGE as BASELINES_MAY_CHANGE
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import InitParts
from rmc.deploy.run.opening import MAY_CHANGE
from rmc.deploy.run.option_names import option
from rmc.deploy.run.starts import format_starts, starts
from tests.docs.running import DOCS, LOCKSTEP, commands, ran

RESUME, WARM = ((DOCS / name).read_text() for name in ("resume.md", "warm-start.md"))


def execute(page: str, folder: Path, *shorter: str) -> int:
    """Its commands, in order, its trainings with these options; how many they are."""
    for words in commands(page):
        ran(folder, *words, *((*LOCKSTEP, *shorter) if words[0] == "train" else ()))
    return len(commands(page))


def test_a_run_is_resumed(tmp_path: Path) -> None:
    assert execute(RESUME, tmp_path) == 3
    run = RunFolder(tmp_path / "runs" / "first")
    result = run.result()
    assert result is not None
    assert result["env_steps"] >= 2_000
    assert [list(start.changes) for start in starts(run)] == [[], [], ["total_steps", "replay.replay_ratio"]]
    match = re.search(r"```\n(3 starts; .*)\n```", RESUME)
    assert match is not None
    assert re.sub(r"1,5\d\d", "1,500", format_starts(run)) == match[1]


def test_the_options_that_may_change_are_in_the_table() -> None:
    table = RESUME.split("## What may change")[1].split("\n\n")[1]
    assert set(re.findall(r"`(--[a-z-]+)`", table)) == {option(path) for path in MAY_CHANGE}
    line = next(line for line in RESUME.splitlines() if line.startswith("Of a baseline's run"))
    assert set(re.findall(r"`(--[a-z-]+)`", line)) == {option(path) for path in BASELINES_MAY_CHANGE}


def test_runs_begin_with_anothers_networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert execute(WARM, tmp_path, "--total-steps", "700", "--checkpoint-steps", "600") == 3
    (code,) = re.findall(r"```python\n(.*?)```", WARM, re.DOTALL)
    debug = presets.debug
    monkeypatch.setattr(presets, "debug", lambda env: dataclasses.replace(debug(env), total_steps=600))
    monkeypatch.setattr(rmc, "train", functools.partial(rmc.train, launcher="lockstep"))
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    parts = {}
    for name in ("warm", "model", "policy"):
        began = starts(RunFolder(tmp_path / "runs" / name))[0].init_from
        assert began is not None
        assert began["run"] == str(tmp_path / "runs" / "source")
        parts[name] = began["parts"]
    assert parts == {"warm": "all", "model": "memory+world-model", "policy": "policy"}
    assert set(re.findall(r"^\| `([a-z][a-z+-]*)` \|", WARM, re.MULTILINE)) == set(get_args(InitParts))
    best = json.loads((tmp_path / "runs" / "source" / "checkpoints" / "best.json").read_bytes())["update"]
    assert f"update {best}" in format_starts(RunFolder(tmp_path / "runs" / "model"))
