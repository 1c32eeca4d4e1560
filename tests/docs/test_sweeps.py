"""The commands of docs/sweeps.md run as they are printed, with one seed and in lockstep; Ray's has tests of its own."""

import functools
import json
import re
from pathlib import Path

import pytest

from tests.command import rmc

FEWER = {
    'seeds = "1-2"': "seeds = 1", "--seeds 1-2": "--seeds 1", "=3e-4,1e-3": "=1e-3",
    "total_steps = 1_200": "total_steps = 700", "--total-steps 1200": "--config fewer.toml --total-steps 700",
}  # fmt: skip
PAGE = (Path(__file__).parents[2] / "docs" / "sweeps.md").read_text()


@pytest.mark.timeout(500)
def test_its_commands_run(tmp_path: Path) -> None:
    assert all(printed in PAGE for printed in FEWER)
    page = functools.reduce(lambda text, one: text.replace(*one), FEWER.items(), PAGE)
    (tmp_path / "fewer.toml").write_text('launcher = "lockstep"\n')
    (tmp_path / "rates.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    commands = [line for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) for line in block.splitlines()]
    assert len(commands) == 5
    on_ray = [command for command in commands if "--launcher ray" in command]
    assert len(on_ray) == 1
    tables = {}
    for command in (one for one in commands if one not in on_ray):
        done = rmc(*command.split()[1:], cwd=tmp_path, timeout=300)
        assert (done.returncode, done.stderr) == (0, ""), f"{command}\n{done.stdout}{done.stderr}"
        tables[command] = [line.split() for line in done.stdout.splitlines()[-3:]]
    indexes = {path.parent.name: path.read_text().splitlines() for path in tmp_path.glob("runs/*/sweep.jsonl")}
    states = {name: [json.loads(line)["state"] for line in lines] for name, lines in indexes.items()}
    one, two = ["finished"], ["finished"] * 2
    assert states == {"InvertedPendulum-v5__sweep": one, "rates": two, "search": two}
    (search,) = (table for command, table in tables.items() if "--search" in command)
    assert search[0] == ["trial", "learning_rate", "n_step", "seeds", "return"]
    assert sorted(row[0] for row in search[1:]) == ["0", "1"]
    assert float(search[1][-1]) >= float(search[2][-1])
    assert not list((tmp_path / "runs" / "rates").glob("*/replay"))
    assert (tmp_path / "rates.png").stat().st_size > 10_000
