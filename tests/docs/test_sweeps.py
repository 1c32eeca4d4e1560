"""The commands of docs/sweeps.md run as they are printed, with one seed and one trial; Ray's has tests of its own."""

import re
from pathlib import Path

import pytest

from tests.command import rmc

PAGE = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text()


@pytest.mark.timeout(500)
def test_its_commands_run(tmp_path: Path) -> None:
    spec = PAGE.split("```toml\n")[1].split("```")[0]
    (tmp_path / "rates.toml").write_text(spec.replace('seeds = "1-2"', "seeds = 1"))
    commands = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
    assert len(commands) == 5
    on_ray = [command for command in commands if "--launcher ray" in command]
    assert len(on_ray) == 1
    for command in (one for one in commands if one not in on_ray):
        fewer = command.replace("--seeds 1-2", "--seeds 1").replace("--trials 2", "--trials 1")
        done = rmc(*fewer.split()[1:], cwd=tmp_path, timeout=300)
        assert (done.returncode, done.stderr) == (0, ""), f"{command}\n{done.stdout}{done.stderr}"
    runs = {path.parent.name: len(path.read_text().splitlines()) for path in tmp_path.glob("runs/*/sweep.jsonl")}
    assert runs == {"InvertedPendulum-v5__sweep": 2, "rates": 2, "search": 1}
    assert not list((tmp_path / "runs" / "rates").glob("*/replay"))
    assert (tmp_path / "rates.png").stat().st_size > 10_000
