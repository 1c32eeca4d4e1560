"""SIGSTOP of a role, another in its place, SIGCONT after 90 s: ``python -m tests.faults.frozen [--tries 1]``.

Learner and replay server lock their folders, so that the other one has a copy or an empty one, as on another machine.
"""

import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from rmc.deploy.local.role_environment import URL_VARIABLE
from tests.command import COMMAND
from tests.faults.loaded import ROOMY, Loaded
from tests.faults.row import Row, at_length
from tests.faults.witness import went_back
from tests.processes import alive

ENDS_S = 10.0
PATIENT = ("--env-timeout", "1000")  # an actor that stood still does not take its environment for hung


def freeze_all(tries: int, folder: Path, seconds: float = 90.0) -> Iterator[Row]:
    """One role after the other."""
    for role in ("actor-0", "learner", "replay"):
        with Loaded(folder / role, *ROOMY, *PATIENT) as run:
            run.begin()
            row = freeze(run, role, tries, seconds)
            yield row.with_verdict(run.end())


def freeze(run: Loaded, role: str, tries: int, seconds: float) -> Row:
    """So often, each time for so long."""
    slowest, accepted, replaced = 0.0, 0, _says_replaced(run, role)
    for _ in range(tries):
        old, epoch = run.process_of(role), run.bus.current_epoch(role)
        old.suspend()
        with _in_its_place(run, role):
            run.until(lambda epoch=epoch: run.bus.current_epoch(role) > epoch)
            run.until_all_go_on()
            time.sleep(seconds)
            before = run.witness.acks.get((0, epoch), 0)
            old.resume()
            slowest = max(slowest, run.until(lambda old=old: not _runs(old)))
            accepted += run.witness.acks.get((0, epoch), 0) - before if role == "actor-0" else 0
            run.until(lambda epoch=epoch: run.bus.current_epoch(role) > epoch + 1)  # the supervisor's next
        run.until_all_go_on()
    silent = tries - (_says_replaced(run, role) - replaced)
    facts = {
        "ended_for_another_cause": silent,
        "entries_accepted": accepted,
        "acks_went_back": run.witness.acks_went_back,
        "weights_went_back": went_back(run.witness.versions),
    }
    return Row(
        f"SIGSTOP for {seconds:.0f} s, another in its place: {role}", tries,
        not any(facts.values()) and slowest < ENDS_S, recovery_s_max=round(slowest, 2), found=facts,
    )  # fmt: skip


def _says_replaced(run: Loaded, role: str) -> int:
    """How many of its lives have ended because of a newer one."""
    text = (run.folder / "logs" / f"{role}.log").read_text()
    return len(re.findall(r"FencedError: .*replaced", text))


def _runs(process: psutil.Process) -> bool:
    return bool(alive([process]))


@contextmanager
def _in_its_place(run: Loaded, role: str) -> Iterator[None]:
    """The same role once more; ends of itself when it is replaced in turn."""
    words = [*COMMAND, *_words(run, role)]
    environment = {**os.environ, URL_VARIABLE: run.url_of(role)}
    with (run.folder.parent / f"other-{role}.log").open("ab") as log:
        other = subprocess.Popen(words, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    try:
        yield
        other.wait(ENDS_S)
    finally:
        other.kill()
        other.wait()


def _words(run: Loaded, role: str) -> list[str]:
    place = ["--run", run.name]
    secret = ["--secret-file", str(run.folder / "secret")]
    other = run.folder.parent / f"other-{role}"
    shutil.rmtree(other, ignore_errors=True)
    if role.startswith("actor"):
        return ["role", "actor", *place, "--index", role.partition("-")[2]]
    if role == "learner":
        shutil.copytree(run.folder / "checkpoints", other)
        return ["role", "learner", *place, *secret, "--folder", str(other), "--device", "cpu"]
    (socket,) = (path for path in run.sockets() if path.name == "replay.sock")
    listen = f"unix:{socket.with_name('other.sock')}"
    return ["role", "replay", *place, *secret, "--folder", str(other), "--listen", listen, "--shard", "0"]


if __name__ == "__main__":
    at_length(__doc__, freeze_all, tries=1)
