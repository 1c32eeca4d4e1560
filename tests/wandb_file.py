"""Reads what wandb recorded offline: LevelDB's log of protobuf records."""

import json
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from wandb.proto import wandb_internal_pb2

BLOCK, HEAD = 32_768, 7  # bytes; a block's records do not reach into the next


def records(run: Path) -> list[list[Any]]:
    """Those of each start of a run's folder, oldest first."""
    files = run.glob("wandb/offline-run-*/*.wandb")
    return [list(_of(file.read_bytes())) for file in sorted(files, key=lambda file: file.stat().st_mtime)]


def rows(of: Iterable[Any]) -> list[dict[str, Any]]:
    """What was logged, a row each."""
    return [items(record.history.item) for record in of if record.HasField("history")]


def summary(of: Iterable[Any]) -> dict[str, Any]:
    """The newest of each name."""
    return {k: v for record in of if record.HasField("summary") for k, v in items(record.summary.update).items()}


def exit_codes(of: Iterable[Any]) -> list[int]:
    return [record.exit.exit_code for record in of if record.HasField("exit")]


def items(entries: Iterable[Any]) -> dict[str, Any]:
    return {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in entries}


def _of(content: bytes) -> Iterator[Any]:
    at, whole = HEAD, b""
    while at + HEAD <= len(content):
        if BLOCK - at % BLOCK < HEAD:
            at += BLOCK - at % BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + HEAD])
        whole += content[at + HEAD : at + HEAD + length]
        at += HEAD + length
        if kind in (1, 4):  # whole, or the last part
            record = wandb_internal_pb2.Record()
            record.ParseFromString(whole)
            yield record
            whole = b""
