"""``deploy/cluster/worker.sh``, which keeps Ray on a worker. ``make test-cluster`` tries it with Ray itself.

Ray's own ``ray stop`` would end every Ray of this machine, others' too: here ``ray`` is a script that starts and ends
one process, which looks as a raylet does.
"""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from rmc import deploy

SCRIPT = Path(deploy.__file__).parent / "cluster" / "worker.sh"
RAY = """#!/bin/bash
echo "$*" >> {folder}/calls
if [ $1 = start ]; then
  setsid bash -c 'exec -a {folder}/raylet bash -c "read < {folder}/never" raylet --gcs-address=$HEAD' &> /dev/null &
else
  pkill -9 -f "^{folder}/raylet "
fi
exit ${{STATUS:-0}}
"""


class Worker:
    """A machine's home folder with such a ``ray``, and a head that answers while ``head`` is there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "ray").write_text(RAY.format(folder=folder))
        (folder / "ray").chmod(0o755)
        os.mkfifo(folder / "never")
        self.head = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.head.getsockname()[1]}"

    def run(self, *words: str, status: int = 0) -> int:
        environment = os.environ | {"HOME": str(self.folder), "HEAD": self.address, "STATUS": str(status)}
        return subprocess.run([SCRIPT, self.folder / "ray", *words], env=environment, timeout=20).returncode

    def start(self, *options: str, status: int = 0) -> int:
        return self.run("start", f"--address={self.address}", *options, status=status)

    def processes(self, name: str) -> list[int]:
        """Those of this folder whose words have this in them."""
        found = []
        for process in psutil.process_iter(["cmdline"]):
            words = " ".join(process.info["cmdline"] or [])
            if name in words and str(self.folder) in words:
                found.append(process.pid)
        return found

    def calls(self, action: str) -> int:
        return sum(line.startswith(action) for line in (self.folder / "calls").read_text().splitlines())


def wait_for(condition: Callable[[], object], seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Worker]:
    worker = Worker(tmp_path)
    yield worker
    worker.run("stop", "--force")
    worker.head.close()
    assert worker.processes("") == []


def test_it_is_started_again_once_the_head_answers(worker: Worker) -> None:
    assert worker.start() == 0
    (raylet,) = worker.processes("--gcs-address")
    worker.head.close()
    os.kill(raylet, signal.SIGKILL)
    wait_for(lambda: worker.calls("stop") == 2)  # once before the start
    time.sleep(1.0)
    assert worker.calls("start") == 1
    worker.head = socket.create_server(("127.0.0.1", int(worker.address.rpartition(":")[2])))
    wait_for(lambda: worker.calls("start") == 2)
    wait_for(lambda: len(worker.processes("--gcs-address")) == 1)


def test_what_is_kept_is_left_alone_but_with_other_options(worker: Worker) -> None:
    worker.start("--num-cpus=1")
    raylets = worker.processes("--gcs-address")
    worker.start("--num-cpus=1")
    assert worker.processes("--gcs-address") == raylets
    worker.start("--num-cpus=2")
    assert len(worker.processes("--gcs-address")) == 1
    assert worker.processes("--gcs-address") != raylets
    assert len(worker.processes("worker.sh")) == 1


def test_stop_ends_all(worker: Worker) -> None:
    worker.start()
    worker.run("stop", "--force")
    assert worker.processes("") == []
    time.sleep(1.5)
    assert worker.calls("start") == 1


def test_what_cannot_start_is_not_kept(worker: Worker) -> None:
    assert worker.start(status=3) == 3
    assert worker.processes("worker.sh") == []
