"""A file of metrics is read while it grows, and a long one is not parsed as a whole."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from rmc.deploy.run import metrics_tail
from rmc.deploy.run.metrics_tail import MetricsTail


def test_records_are_taken_once_and_whole(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    tail = MetricsTail(path)
    assert tail.take() == []
    with path.open("a") as file:
        file.write(json.dumps({"role": "a"}) + "\n" + '{"torn": \n' + '{"role": "b"')
        file.flush()
        assert tail.take() == [{"role": "a"}]
        file.write(', "x": 1}\n')
        file.flush()
        assert tail.take() == [{"role": "b", "x": 1}]
    assert tail.take() == []


def test_records_are_taken_in_parts(tmp_path: Path) -> None:
    records = [{"role": "a", "x": number} for number in range(50)]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(f"{json.dumps(record)}\n" for record in records))
    tail = MetricsTail(path)
    parts = [tail.take(100) for _ in range(20)]
    assert [record for part in parts for record in part] == records
    assert max(map(len, parts)) == 4  # of 23 bytes or more


def test_what_is_longer_than_a_look_is_passed_over(tmp_path: Path) -> None:
    """A disk that has lost a block shows zeros there."""
    path, record = tmp_path / "metrics.jsonl", json.dumps({"role": "a"}).encode()
    path.write_bytes(record + b"\n" + bytes(1_000) + b"\n" + record + b"\n")
    tail = MetricsTail(path, recent_bytes=None)
    parts = [tail.take(100) for _ in range(20)]
    assert [one for part in parts for one in part] == [{"role": "a"}] * 2
    assert tail.at_end


def test_records_after_a_cut_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text(f"{json.dumps({'role': 'a', 'x': 'long' * 99})}\n")
    tail = MetricsTail(path)
    tail.take()
    os.truncate(path, 10)
    assert tail.take() == []
    with path.open("a") as file:
        file.write("\n" + json.dumps({"role": "b"}) + "\n")
    assert tail.take() == [{"role": "b"}]


def long_file(path: Path, lines: int) -> tuple[list[dict[str, Any]], int]:
    """Records of a learner with an evaluation now and then: those evaluations, and the file's size."""
    evaluations = []
    with path.open("wb") as file:
        for number in range(lines):
            record = {"role": "learner", "updates": number, "text": "x" * 900}
            if number % 5000 == 100:
                record = {"role": "evaluator", "eval_return_mean": float(number), "eval_update": number}
                evaluations.append(record)
            file.write(json.dumps(record).encode() + b"\n")
    return evaluations, path.stat().st_size


def test_of_a_long_file_only_evaluations_and_its_end_are_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is parsed must not grow with the file."""
    path, parsed, parse, recent = tmp_path / "metrics.jsonl", [], metrics_tail.parse_record, 1 << 20

    def counted(line: bytes) -> dict[str, Any] | None:
        parsed.append(len(line))
        return parse(line)

    monkeypatch.setattr(metrics_tail, "parse_record", counted)
    evaluations, size = long_file(path, 12_000)
    assert size > 10 * recent
    tail = MetricsTail(path, recent)
    records = tail.take()
    assert sum(parsed) < recent + 100 * len(evaluations)
    assert [record for record in records if record["role"] == "evaluator"] == evaluations
    assert records[-1]["updates"] == 11_999
    assert tail.take() == []


def test_wherever_the_end_begins_each_evaluation_comes_once(tmp_path: Path) -> None:
    """Also where it begins within one, and where one is torn."""
    path = tmp_path / "metrics.jsonl"
    evaluations, _ = long_file(path, 120)
    with path.open("ab") as file:
        file.write(b'{"role": "evaluator", "eval_return_mean": \n"eval_return_mean"\n')
        for number in (1.0, 2.0):
            evaluations.append({"role": "evaluator", "eval_return_mean": number})
            file.write(json.dumps(evaluations[-1]).encode() + b"\n")
    for recent in [*range(200), 10**9]:
        records = MetricsTail(path, recent).take()
        assert [record for record in records if record["role"] == "evaluator"] == evaluations, recent
