"""The commands of docs/command-line.md run as they are printed."""

import json
import re
from pathlib import Path

import pytest

from rmc.cli import main
from tests.docs.running import DOCS, LOCKSTEP, commands, ran

PAGE = (DOCS / "command-line.md").read_text()


def test_a_file_of_options_trains(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(PAGE.split("```toml\n")[1].split("```")[0])
    for words in commands(PAGE):
        ran(tmp_path, *words, *LOCKSTEP)
    files = (tmp_path / "runs" / name / "config.json" for name in ("from-file", "seed-1"))
    first, second = (json.loads(file.read_bytes()) for file in files)
    assert (first["total_steps"], first["agent"]["heads"], first["env"]["env_kwargs"]) == (
        1_200, [24, 16], {"reset_noise_scale": 0.02},
    )  # fmt: skip
    assert (second["total_steps"], second["seed"], second["update"]["learning_rate"]) == (1_000, 1, 1e-3)


def test_every_shell_of_the_page_has_a_script(capsys: pytest.CaptureFixture[str]) -> None:
    shells = re.findall(r"^\| \w+ \| `rmc completion (\w+) >", PAGE, re.MULTILINE)
    assert shells == ["bash", "zsh", "fish"]
    for shell in shells:
        assert main.run(["completion", shell]) == 0
        assert "check-env" in capsys.readouterr().out
