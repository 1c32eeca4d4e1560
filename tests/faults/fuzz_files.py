"""Strangers' files, changed at random: ``python -m tests.faults.fuzz_files [--tries 1000000]``, so many of each.

Policies, config.json, and all that commands read in a run's folder: what they hold is shown, or refused in one line.
Nothing else may come of it: no program, no socket, no class out of a pickle; no long wait, no memory.
"""

import contextlib
import copy
import fcntl
import hashlib
import io
import json
import logging
import random
import re
import shutil
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rmc.analysis import curves, history
from rmc.analysis.live_run import LiveRun
from rmc.analysis.policy import load_policy
from rmc.analysis.report import CHARTS, differences, newest
from rmc.analysis.report_run import ReportRun
from rmc.cli import commands
from rmc.cli.run_options import Doctor, List, Stats
from rmc.common.checkpoint import MANIFEST, POLICY, PROGRESS, CheckpointFolder
from rmc.common.errors import RmcError
from rmc.common.policy_header import METADATA_KEY
from rmc.deploy.monitor.view import terminal
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.metrics_tail import wall_seconds
from rmc.deploy.run.starts import format_starts, last_launch
from rmc.deploy.run.validation import validate
from tests.faults.fuzz import Case, mutate, tried
from tests.faults.row import Row, at_length

OLD_RUNS = Path(__file__).parents[1] / "deploy" / "runs"
SHARED_MEMORY = Path("/dev/shm")
SLOWEST_S = 0.25
FILES = ("policies", "config.json", "folders of runs")  # that are changed
Change = Callable[[bytes, random.Random], bytes]
View = Callable[[Path], None]
FORBIDDEN = {
    "subprocess.Popen",
    "os.exec",
    "os.fork",
    "os.system",
    "os.posix_spawn",
    "pickle.find_class",
    "socket.connect",
}
READING: list[Path] = []  # what is read now; the script itself may do more
LONGEST_LINE = 100_000  # of a refusal: it quotes a value, whole
DEEP, LONG, LARGE = "[" * 5000 + "]" * 5000, "9" * 5000, "1e999"
RAW = {"@deep": DEEP, "@long": LONG, "@large": LARGE}  # what json.dumps does not write
ODD_VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 1, 3, 2**31, 2**53, 2**63, 2**64, -(2**63), 10**30, 10**400, 0.5, -0.5, 1e308, -1e308,
    5e-324, float("nan"), float("inf"), float("-inf"), "", "x", "[/x]", "{0}", "%s", "\ud800", "\x00", "a\nb",
    "\x1b[2J", "../x", "nan", "7", "x" * 5000, [], [1] * 9, [None], [[]], ["a", 1], {}, {"x": 1}, {"": {}}, *RAW,
)  # fmt: skip
RAW_VALUES = re.compile("|".join(f'"{name}"' for name in RAW))


def odd_json(raw: bytes, rng: random.Random) -> bytes:
    """The same with one to three values of another kind or size, or gone, or there twice."""
    value = json.loads(raw)
    for _ in range(rng.randint(1, 3)):
        holder = rng.choice([*_holders(value)] or [{}])
        name = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder))) if holder else ""
        match rng.randrange(8):
            case 0 if holder:
                del holder[name]
            case 1 if isinstance(holder, dict):
                holder[rng.choice(("x", "", "role", "format", "\ud800", "a b", "{", "time", "algorithm"))] = 1
            case 2 if holder:
                holder[name] = json.loads(json.dumps(rng.choice(list(_holders(value)))))
            case _ if holder:
                holder[name] = copy.deepcopy(rng.choice(ODD_VALUES))
    if rng.random() < 0.02:
        value = rng.choice(ODD_VALUES)
    text = RAW_VALUES.sub(lambda found: RAW[found[0].strip('"')], json.dumps(value))
    if rng.random() < 0.05 and text.startswith('{"'):
        text = f"{text[:-1]}, {text[1:]}"
    return text.encode(*rng.choices([("utf-8",), ("utf-16",)], [0.98, 0.02])[0])


def _holders(value: Any) -> Iterator[Any]:
    if isinstance(value, dict | list):
        yield value
        for item in value.values() if isinstance(value, dict) else value:
            yield from _holders(item)


def odd_lines(raw: bytes, rng: random.Random) -> bytes:
    """One to three lines of JSON changed, or there again elsewhere."""
    lines = raw.splitlines()
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(len(lines))
        changed = (odd_json if rng.random() < 0.9 else mutate)(lines[place], rng)
        if rng.random() < 0.2:
            lines.insert(rng.randrange(len(lines) + 1), lines[place])
        with contextlib.suppress(ValueError, RecursionError):
            json.loads(changed)  # else the next round cannot change it
            lines[place] = changed
            continue
        lines.append(changed)
        break
    return b"\n".join([*lines, b""])


def odd_policy(raw: bytes, rng: random.Random) -> bytes:
    """Another header of the right length: of safetensors itself, or what RMC has written into it."""
    end = 8 + int.from_bytes(raw[:8], "little")
    header = raw[8:end]
    whole = json.loads(header)
    facts = whole.get("__metadata__")  # of an older run's there are none
    if facts and rng.random() < 0.7:
        facts[METADATA_KEY] = odd_json(facts[METADATA_KEY].encode(), rng).decode(errors="replace")
        header = json.dumps(whole).encode()
    else:
        header = odd_json(header, rng)
    return len(header).to_bytes(8, "little") + header + raw[end:]


def odd_text(raw: bytes, rng: random.Random) -> bytes:
    """Another word in a line."""
    words: list[Any] = raw.decode().split()
    words[rng.randrange(len(words))] = rng.choice(ODD_VALUES)
    return " ".join(map(str, words)).encode(errors="surrogatepass")


def stats(run: Path) -> None:
    """As on a console, and as JSON."""
    commands.stats(Stats(run))
    commands.stats(Stats(run, json=True))


def listed(run: Path) -> None:
    commands.list_runs(List(run.parent))
    commands.list_runs(List(run.parent, json=True))


def plotted(run: Path) -> None:
    """Its table, without the picture."""
    groups = curves.grouped(history.read_histories(run))
    terminal().print(*curves.tables(groups, None))


def reported(run: Path) -> None:
    """All that a page says, without its pictures: those play."""
    one = ReportRun.read(run)
    newest([one])
    differences([one])
    differences([one, one])
    str((one.name, one.state, one.env_steps, one.findings, format_starts(one.folder), one.about))
    if one.history is not None:
        curves.cells([one.history])
    for _, _, lines in CHARTS:
        for metric in lines.values():
            one.series(*metric)


def watched(run: Path) -> None:
    """Twice, as a browser is told of it."""
    live = LiveRun("run", run)
    json.dumps([live.look(), live.look(), live.everything()], allow_nan=False).encode()


def diagnosed(run: Path) -> None:
    commands.doctor(Doctor(run))


def resumed(run: Path) -> None:
    """As far as before anything starts."""
    folder = RunFolder(run)
    validate(folder.config())
    last_launch(folder)
    CheckpointFolder(folder.checkpoints).latest()
    CheckpointFolder(folder.checkpoints).last_save()
    folder.check_sizes("x", {"observations": 4, "actions": 1})
    folder.initial(), wall_seconds(folder.metrics), folder.name


def acted(run: Path) -> None:
    """A step with its newest policy."""
    policy = load_policy(run)
    policy.header.summary()
    policy.act([0.0] * policy.header.obs_dim, units="environment")


def best(run: Path) -> None:
    load_policy(run, "best")


VIEWS: tuple[View, ...] = (
    stats, listed, plotted, reported, watched, diagnosed, resumed, acted, best,
)  # fmt: skip


def configured(run: Path) -> None:
    """What every command does first."""
    folder = RunFolder(run)
    validate(folder.config())
    folder.settings()


def write(file: Path, raw: bytes) -> None:
    """A stranger's checkpoint is whole, whatever it holds."""
    file.write_bytes(raw)
    if file.name in (POLICY, PROGRESS) and (file.parent / MANIFEST).exists():
        write_manifest(file.parent)


def write_manifest(checkpoint: Path) -> None:
    """Of files as they are."""
    digests = {name: hashlib.sha256((checkpoint / name).read_bytes()).hexdigest() for name in (POLICY, PROGRESS)}
    text = json.dumps({"update": int(checkpoint.name), "sha256": digests}, indent=1)
    (checkpoint / MANIFEST).write_text(text)


def read_changed(raw: bytes, file: Path, lawful: bytes, view: View, source: Path) -> None:
    """``view`` of the ``source`` with other bytes in a file, which are lawful again then."""
    write(file, raw)
    READING.append(source)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            view(source)
    except RmcError as error:
        if "\n" in str(error) or len(str(error)) > LONGEST_LINE:
            raise ValueError(f"no line: {str(error)[:200]!r}") from None
        raise
    finally:
        READING.pop()
        write(file, lawful)


Target = tuple[Path, Change, tuple[View, ...], Path]  # the file, and what reads it where


def old_run(place: Path, name: str) -> Path:
    """A finished run, with the least of what is read: its ring and the learner's state are not."""
    with tarfile.open(OLD_RUNS / f"{name}.tar.xz") as archive:
        archive.extractall(place, filter="data")
    run = place / name
    shutil.rmtree(run / "replay")
    checkpoint = next((run / "checkpoints").glob("[0-9]*"))
    (checkpoint / "learner.pt").unlink()
    write_manifest(checkpoint)
    (run / ".lock").write_text("ended 0")
    return run


@contextlib.contextmanager
def unfinished(run: Path) -> Iterator[Path]:
    """A copy that is trained now: then roles may be silent."""
    going = Path(shutil.copytree(run, run.parent / "going" / "run"))
    (going / "result.json").unlink()
    (going / ".lock").write_text("training 1 host")
    with (going / ".lock").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield going


def in_run(run: Path) -> list[Target]:
    """What commands read there."""
    checkpoint = next((run / "checkpoints").glob("[0-9]*"))
    changes: dict[Path, Change] = {run / "metrics.jsonl": odd_lines, checkpoint / POLICY: odd_policy}
    changes |= {run / ".lock": odd_text, checkpoint.parent / "save-seconds": odd_text}
    changes |= dict.fromkeys(run.glob("history.jsonl"), odd_lines)
    small = [*run.glob("*.json"), checkpoint.parent / "best.json", checkpoint / MANIFEST, checkpoint / PROGRESS]
    changes |= dict.fromkeys(small, odd_json)
    return [(path, change, VIEWS, run) for path, change in changes.items()]


def cases(targets: list[Target], count: int, seed: int) -> Iterator[Case]:
    """So many, all files and all that reads them in turn."""
    rng, lawful = random.Random(seed), {file: file.read_bytes() for file, *_ in targets}
    for number in range(count):
        file, change, views, source = targets[number % len(targets)]
        raw = (change if rng.random() < 0.8 else mutate)(lawful[file], rng)
        view = views[number // len(targets) % len(views)]
        yield file.name, raw, partial(read_changed, file=file, lawful=lawful[file], view=view, source=source)


def fuzz(count: int, seed: int = 0) -> Iterator[Row]:
    """So many of each. Raises whatever is no refusal."""
    with tempfile.TemporaryDirectory(dir=SHARED_MEMORY) as place, contextlib.ExitStack() as stack:
        runs = [old_run(Path(place) / name, name) for name in ("format-2", "format-1-b")]
        runs.append(stack.enter_context(unfinished(runs[0])))
        policy, lines = Path(place) / "policy.safetensors", Path(place) / "runs.jsonl"
        policy.write_bytes(next(runs[0].glob(f"checkpoints/*/{POLICY}")).read_bytes())
        lines.write_text(history.of_run(RunFolder(runs[0])).to_line() + "\n")
        of_runs = [target for run in runs for target in in_run(run)]
        kinds: tuple[list[Target], ...] = (
            [(policy, odd_policy, (acted,), policy)],
            [(run / "config.json", odd_json, (configured,), run) for run in runs],
            [*of_runs, (lines, odd_lines, (plotted,), lines)],
        )
        for name, targets in zip(FILES, kinds, strict=True):
            yield tried(f"strangers' {name}", cases(targets, count, seed), count, SLOWEST_S)


def forbid(event: str, args: tuple[Any, ...]) -> None:
    """Ends the script where what was read makes something run."""
    if READING and event in FORBIDDEN:
        raise AssertionError(f"{event} {args}")


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    sys.addaudithook(forbid)
    at_length(__doc__, lambda tries, folder: fuzz(tries), tries=1_000_000)
