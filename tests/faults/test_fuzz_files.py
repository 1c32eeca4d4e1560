"""The short form of ``fuzz_files.py``, and what it has found."""

import json
from contextlib import suppress
from pathlib import Path

import pytest

from rmc.common.errors import ConfigError, RmcError
from tests.faults import fuzz_files
from tests.faults.fuzz_files import FILES, read_changed

DEEP = fuzz_files.DEEP
HUGE = "1" + "0" * 400
START = '{"time": 1, "version": "1", "env_steps": 0, '
CHECKPOINT = "checkpoints/000000081"
LAWFUL_LINE = '{"agent": "a", "env": "e", "seed": 0, "env_steps": 1, "updates": 1, "transitions": 1, "wall_s": 1.0, '
EVALUATIONS = '"evaluations": [{"env_steps": 1, "updates": 1, "wall_s": 1.0, "return_mean": 1.0, "return_std": 0.0}], '


@pytest.mark.filterwarnings("ignore:Initializing zero-element", "ignore:overflow", "ignore:invalid value")
def test_changed_files_are_shown_or_refused_in_a_line() -> None:
    rows = list(fuzz_files.fuzz(300, seed=1))
    assert len(rows) == len(FILES)
    for row in rows:
        assert row.passed, row
        assert any(name.endswith("taken") for name in row.found), row
        assert any(name.endswith("option") for name in row.found), row


@pytest.mark.parametrize(
    ("file", "text", "view"),
    [
        ("config.json", DEEP, fuzz_files.configured),
        ("result.json", DEEP, fuzz_files.stats),
        ("metrics.jsonl", f"{DEEP}\n", fuzz_files.listed),
        ("metrics.jsonl", '{"role": "replay-0", "env_steps_per_s": "x"}\n', fuzz_files.stats),
        ("history.jsonl", START + '"changes": {"a": [1]}}\n', fuzz_files.stats),
        ("history.jsonl", START + '"init_from": {}}\n', fuzz_files.watched),
        ("history.jsonl", START.replace("0,", '"x",') + '"changes": {"a": [1, 2]}}\n', fuzz_files.reported),
        ("checkpoints/best.json", '{"update": 1e999, "eval_return_mean": 0}', fuzz_files.best),
        ("sizes.json", '{"observations": "a\\nb"}', fuzz_files.resumed),
        (f"{CHECKPOINT}/manifest.json", DEEP, fuzz_files.acted),
        (f"{CHECKPOINT}/manifest.json", '{\n "update": 81,\n "sha256": {}\n}', fuzz_files.acted),
    ],
)
def test_files_that_once_were_a_traceback(file: str, text: str, view: fuzz_files.View, tmp_path: Path) -> None:
    run = fuzz_files.old_run(tmp_path, "format-2")
    look(run / file, text, view, run)


def test_an_option_with_a_line_break_in_its_name_is_refused_in_a_line(tmp_path: Path) -> None:
    run = fuzz_files.old_run(tmp_path, "format-2")
    config = run / "config.json"
    config.write_text(config.read_text().replace('"chunk_seconds"', '"chunk_seco\\nds"'))
    with pytest.raises(ConfigError) as caught:
        fuzz_files.configured(run)
    assert "chunk_seco\\nds'=0.5: no such option in this version" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "option", "value", "view"),
    [
        ("format-2", "update.learning_rate", HUGE, fuzz_files.configured),
        ("format-2", "env", "7", fuzz_files.acted),
        ("format-1-b", "agent.hidden", str(2**63), fuzz_files.best),
        ("format-1-b", "agent.hidden", "65536", fuzz_files.acted),
        ("format-1-b", "env.frame_stack", str(10**30), fuzz_files.best),
    ],
)
def test_options_that_once_were_a_traceback(
    name: str, option: str, value: str, view: fuzz_files.View, tmp_path: Path
) -> None:
    run = fuzz_files.old_run(tmp_path, name)
    settings = json.loads((run / "config.json").read_bytes())
    *parts, key = option.split(".")
    (settings[parts[0]] if parts else settings)[key] = json.loads(value)
    look(run / "config.json", json.dumps(settings), view, run)


@pytest.mark.parametrize("finished", ["[]", DEEP])
def test_a_line_that_once_was_a_traceback(finished: str, tmp_path: Path) -> None:
    lines = tmp_path / "runs.jsonl"
    lines.write_text("")
    look(
        lines, f'{LAWFUL_LINE}{EVALUATIONS}"initial_return": null, "finished": {finished}}}', fuzz_files.plotted, lines
    )


def look(file: Path, text: str, view: fuzz_files.View, source: Path) -> None:
    """Shown or refused: what else it raises fails the test."""
    with suppress(RmcError):
        read_changed(text.encode(), file, file.read_bytes(), view, source)
