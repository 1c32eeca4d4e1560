"""The commands of docs/sweeps.md run as they are printed, with one seed and one trial; Ray's has tests of its own."""

import functools
import re
from pathlib import Path

import pytest

from tests.command import rmc

FEWER = {
    'seeds = "1-2"': "seeds = 1", "--seeds 1-2": "--seeds 1", "--trials 2": "--trials 1", "=3e-4,1e-3": "=1e-3",
    "total_steps = 1_200": "total_steps = 700", "--total-steps 1200": "--total-steps 700",
}  # fmt: skip
PAGE = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text()


@pytest.mark.timeout(500)
def test_its_commands_run(tmp_path: Path) -> None:
    assert all(printed in PAGE for printed in FEWER)
    page = functools.reduce(lambda text, one: text.replace(*one), FEWER.items(), PAGE)
    (tmp_path / "rates.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    commands = [line for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) for line in block.splitlines()]
    assert len(commands) == 5
    on_ray = [command for command in commands if "--launcher ray" in command]
    assert len(on_ray) == 1
    for command in (one for one in commands if one not in on_ray):
        done = rmc(*command.split()[1:], cwd=tmp_path, timeout=300)
        assert (done.returncode, done.stderr) == (0, ""), f"{command}\n{done.stdout}{done.stderr}"
    runs = {path.parent.name: len(path.read_text().splitlines()) for path in tmp_path.glob("runs/*/sweep.jsonl")}
    assert runs == {"InvertedPendulum-v5__sweep": 1, "rates": 2, "search": 1}
    assert not list((tmp_path / "runs" / "rates").glob("*/replay"))
    assert (tmp_path / "rates.png").stat().st_size > 10_000
