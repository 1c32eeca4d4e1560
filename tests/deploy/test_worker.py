"""``deploy/cluster/worker.sh``, which keeps Ray on a worker. ``make test-cluster`` tries it with Ray itself.

Ray's own ``ray stop`` would end every Ray of this machine, others' too: here ``ray`` is a script that starts and ends
two processes, which look as a raylet and its agent do.
"""

import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from rmc import deploy
from tests.processes import matching
from tests.waiting import wait_until

SCRIPT = Path(deploy.__file__).parent / "cluster" / "worker.sh"
RAY = """#!/bin/bash
echo "$*" >> {folder}/calls
if [ $1 = start ]; then
  for name in raylet python3; do
    setsid bash -c 'exec -a $0 bash {folder}/life --gcs-address=$HEAD' {folder}/$name &> /dev/null &
  done
  until [ $(pgrep -fc "^{folder}/(raylet|python3) ") = 2 ]; do sleep 0.05; done
else
  pkill -9 -f "^{folder}/(raylet|python3) "
fi
exit ${{STATUS:-0}}
"""
TIMEOUT = """#!/bin/bash
echo >> {folder}/looks
exec {timeout} "$@"
"""
LIFE = """trap 'echo >> {folder}/ended-in-order; exit' TERM
exec 3<> {folder}/never
while true; do read -t 0.1 <&3; done
"""  # without a process of its own, which would look as it does


class Worker:
    """A machine's home folder with such a ``ray``, and a head that answers while ``head`` is there.

    By ``timeout`` the script looks whether it answers, which is noted.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "ray").write_text(RAY.format(folder=folder))
        (folder / "timeout").write_text(TIMEOUT.format(folder=folder, timeout=shutil.which("timeout")))
        for name in ("ray", "timeout"):
            (folder / name).chmod(0o755)
        os.mkfifo(folder / "never")
        (folder / "life").write_text(LIFE.format(folder=folder))
        self.head = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.head.getsockname()[1]}"

    def run(self, *words: str, status: int = 0) -> int:
        environment = os.environ | {"HOME": str(self.folder), "HEAD": self.address, "STATUS": str(status)}
        environment["PATH"] = f"{self.folder}:{environment['PATH']}"
        return subprocess.run([SCRIPT, self.folder / "ray", *words], env=environment, timeout=20).returncode

    def start(self, *options: str, status: int = 0) -> int:
        return self.run("start", f"--address={self.address}", *options, status=status)

    def processes(self, name: str) -> list[int]:
        """Those of this folder whose words have this in them."""
        return [one.pid for one in matching(rf"{self.folder}.*{name}|{name}.*{self.folder}", psutil.process_iter())]

    def looks(self) -> int:
        """How often it has asked the head."""
        path = self.folder / "looks"
        return len(path.read_text()) if path.exists() else 0

    def calls(self, action: str) -> int:
        return sum(line.startswith(action) for line in (self.folder / "calls").read_text().splitlines())


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Worker]:
    worker = Worker(tmp_path)
    yield worker
    worker.run("stop", "--force")
    worker.head.close()
    wait_until(lambda: not worker.processes(""))  # one that was killed is there for a moment yet


def test_it_is_started_again_once_the_head_answers(worker: Worker) -> None:
    assert worker.start() == 0
    (raylet,) = worker.processes("/raylet ")
    worker.head.close()
    os.kill(raylet, signal.SIGKILL)
    wait_until(lambda: not worker.processes("--gcs-address"))  # what it left is ended, too
    looks = worker.looks()
    wait_until(lambda: worker.looks() >= looks + 2)  # of which the first was in vain
    assert worker.calls("start") == 1
    worker.head = socket.create_server(("127.0.0.1", int(worker.address.rpartition(":")[2])))
    wait_until(lambda: worker.calls("start") == 2)
    wait_until(lambda: len(worker.processes("--gcs-address")) == 2)
    assert not (worker.folder / "ended-in-order").exists()


def test_what_is_kept_is_left_alone_but_with_other_options(worker: Worker) -> None:
    worker.start("--num-cpus=1")
    raylets = worker.processes("--gcs-address")
    worker.start("--num-cpus=1")
    assert worker.processes("--gcs-address") == raylets
    worker.start("--num-cpus=2")
    assert len(worker.processes("--gcs-address")) == 2
    assert not set(raylets).intersection(worker.processes("--gcs-address"))
    wait_until(lambda: len(worker.processes("worker.sh")) == 1)  # it looks by a process of its own


def test_stop_ends_all_and_the_raylet_in_order(worker: Worker) -> None:
    worker.start()
    worker.run("stop", "--force")
    assert (worker.folder / "ended-in-order").read_text() == "\n"
    wait_until(lambda: not worker.processes(""))  # so that nobody starts it again
    assert worker.calls("start") == 1


def test_what_cannot_start_is_not_kept(worker: Worker) -> None:
    assert worker.start(status=3) == 3
    assert worker.calls("start") == 3
    assert worker.processes("worker.sh") == []
