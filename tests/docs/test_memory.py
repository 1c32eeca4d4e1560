"""The commands of docs/memory.md run as they are printed."""

import re
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from rmc.actors.config import ActorConfig
from rmc.cli import dry_run
from rmc.deploy.run.config import WindowConfig
from tests.cli.test_dry_run import MEASURED
from tests.docs.running import DOCS, LOCKSTEP, commands, ran

PAGE = (DOCS / "memory.md").read_text()
SHORT = ("--preset", "debug", *LOCKSTEP, "--total-steps", "600")


def test_its_commands_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dry_run, "run_trial", lambda *_: MEASURED)
    printed = commands(PAGE)
    assert [words[0] for words in printed] == ["check-env", "train", "train", "inspect"]
    outputs = [ran(tmp_path, *words, *(SHORT if "--run-dir" in words else ())) for words in printed]
    assert "cannot learn of anything older than 15 steps; episodes last up to 200 (--trained-steps, or" in outputs[0]
    assert outputs[1].splitlines()[-1] == "it fits"
    assert "cannot learn of anything older than 50 steps; episodes last up to 200 (--trained-steps, or" in outputs[2]
    for row in (r"first +h .*%", r"later +action .*%", r"observation, where missing +-?\d"):
        assert re.search(f"^{row}", outputs[3], re.MULTILINE), outputs[3]
    assert (tmp_path / "inspect.png").exists()


def test_its_tables_have_the_defaults_and_every_strategy() -> None:
    window = WindowConfig()
    assert f"| `--trained-steps` | {window.trained_steps} |" in PAGE
    assert f"| `--burn-in` | {window.burn_in} |" in PAGE
    strategies = re.findall(r"^\| `(\w[\w-]*)` \|", PAGE.split("## What a window starts from")[1], re.MULTILINE)
    assert sorted(strategies) == sorted(get_args(get_type_hints(ActorConfig)["state_strategy"]))
    assert len(PAGE.splitlines()) <= 105
