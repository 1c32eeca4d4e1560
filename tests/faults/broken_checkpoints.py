"""Checkpoints with one bit flipped, or cut short: ``python -m tests.faults.broken_checkpoints [--tries 200]``."""

import logging
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

from rmc.common.checkpoint import CheckpointFolder
from tests.faults.row import Row, at_length
from tests.integration.running import Training

CUT_SHARE = 5  # one is cut short for so many with a flipped bit


def break_checkpoints(tries: int, folder: Path) -> Iterator[Row]:
    """Of a real run, each with an older one beside it, which is then used, and said."""
    with Training(folder / "run", "--total-steps", "1200", "--checkpoint-steps", "500", "--replay-ratio", "4") as run:
        assert run.finish(120) == 0, run.text()
    yield spoil_each(tries, CheckpointFolder(folder / "run" / "checkpoints"), folder / "copy")


def spoil_each(tries: int, place: CheckpointFolder, copy: Path) -> Row:
    """The newest of those, which lies in ``copy`` meanwhile."""
    chance, warnings = random.Random(0), Said()
    logging.getLogger("rmc.common.checkpoint").addHandler(warnings)
    older, newest = place.numbers()[-2:]
    counts = {"flipped": 0, "cut": 0, "older_used": 0, "said": 0}
    shutil.copytree(place.path(newest), copy)
    cuts = tries // CUT_SHARE
    for number in range(tries + cuts):
        how = "flipped" if number < tries else "cut"
        spoil(chance.choice(sorted(place.path(newest).iterdir())), how, chance)
        lines = len(warnings.lines)
        used = place.latest()
        counts[how] += used is None or used[0] != newest
        counts["older_used"] += used is not None and used[0] == older
        counts["said"] += len(warnings.lines) > lines
        shutil.rmtree(place.path(newest))
        shutil.copytree(copy, place.path(newest))
    logging.getLogger("rmc.common.checkpoint").removeHandler(warnings)
    whole = place.latest()
    passed = set(counts.values()) == {tries, cuts, tries + cuts} and whole is not None and whole[0] == newest
    return Row("checkpoints with a flipped bit, or cut short", tries + cuts, passed, found={**counts})


def spoil(path: Path, how: str, chance: random.Random) -> None:
    """Flip a bit of it, or have it ``cut`` short."""
    content = bytearray(path.read_bytes())
    place = chance.randrange(len(content))
    if how == "cut":
        del content[place:]
    else:
        content[place] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


class Said(logging.Handler):
    """The lines of a log."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


if __name__ == "__main__":
    at_length(__doc__, break_checkpoints, tries=200)
