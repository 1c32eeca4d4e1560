"""The short forms: every fault once, in their order, in one run, whose ring is judged at the end.

A second run has a ring that is full and wraps.
"""

import os
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from rmc.common.checkpoint import CheckpointFolder
from tests.faults.broken_checkpoints import spoil_each
from tests.faults.clock import HOURS, hours_away, other_clock, set_clock
from tests.faults.disk_full import cannot_log, filled, goes_on_unsaved, small_disk
from tests.faults.frozen import freeze
from tests.faults.kill_redis import LoggedRedis, logged_redis
from tests.faults.kill_replay import strike_everywhere, tree_is_its_rebuild
from tests.faults.loaded import ROOMY, Loaded
from tests.faults.slow_learner import SLOWER, judged
from tests.faults.soak import soaked
from tests.faults.witness import went_back

SOON = "--publish-updates", "2", "--threads", "1"  # all go on once actors have newer weights
OPTIONS = (*ROOMY, *SOON, "--checkpoint-steps", "1000")  # none is evicted before all is judged
FULL = (*SOON, "--capacity", "300")  # windows
EARLY_RATIO = 0.1  # off its own, as a share
MOST_GROWTH = 0.05  # of a role's memory within seconds
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="hooks of a fork server, small disks, memory by /proc")
compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="the other clock is in C")
root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> None:
    """Not after each of these tests, which share a run."""


class Place:
    """Where it happens: a folder, a small disk for the run and one for the log of its Redis."""

    def __init__(self, folder: Path, leave: ExitStack) -> None:
        self.folder, self.disks = folder, {}
        for name, megabytes in (("run", 400), ("log", 300)):
            self.disks[name] = folder / f"{name}-disk"
            if os.geteuid() == 0:
                leave.enter_context(small_disk(self.disks[name], megabytes))
            else:
                self.disks[name].mkdir()
        (self.disks["run"] / "run").mkdir()
        (folder / "run").symlink_to(self.disks["run"] / "run")  # what it prints goes elsewhere
        self.environment = other_clock(folder) if shutil.which("cc") else {}
        self.redis: LoggedRedis = leave.enter_context(logged_redis(self.disks["log"] / "redis", folder / "redis.said"))

    def start(self) -> Loaded:
        """The run, or the run again."""
        return Loaded(self.folder / "run", *OPTIONS, redis_url=self.redis.url, environment=self.environment)

    def start_full(self) -> Loaded:
        """The second run."""
        return Loaded(self.folder / "full", *FULL, redis_url=self.redis.url)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    with ExitStack() as leave:
        yield Place(tmp_path_factory.mktemp("faults"), leave)


@pytest.fixture(scope="module")
def run(place: Place) -> Iterator[Loaded]:
    with place.start() as run:
        run.begin()
        yield run


@pytest.fixture(scope="module")
def full(place: Place) -> Iterator[Loaded]:
    with place.start_full() as run:
        run.begin()
        run.until(lambda: run.newest("replay", "ring_fill") == 1.0)
        yield run


def test_an_actor_is_killed(run: Loaded) -> None:
    run.kill("actor-1")
    run.until_all_go_on()


def test_the_learner_is_killed_also_amid_saving(run: Loaded) -> None:
    run.until(CheckpointFolder(run.folder / "checkpoints").numbers)
    run.kill("learner")
    run.strike("half-a-checkpoint", "learner")
    run.until_all_go_on()
    assert [one["same"] for one in run.events("resumed")] == [True, True]


def test_roles_that_somebody_asks_to_end_start_again(run: Loaded) -> None:
    """As kill and earlyoom do. An actor's three ends in a row are not its own."""
    for role in ("learner", "replay", "actor-0", "actor-0", "actor-0", "actor-0"):
        run.kill(role, signal.SIGTERM)
    run.until_all_go_on()


def test_a_loss_is_no_number(run: Loaded) -> None:
    epoch = run.bus.current_epoch("learner")
    run.arm("nan")
    run.until(lambda: run.bus.current_epoch("learner") > epoch)
    run.until_all_go_on()
    assert "training has diverged, weights are not finite" in (run.folder / "logs" / "learner.log").read_text()


def test_redis_is_killed(place: Place, run: Loaded) -> None:
    place.redis.kill()
    place.redis.start()
    run.until_all_go_on()
    run.witness.redis_came_back()  # its log may lack the last second's weights, which are then published anew


@compiler
def test_the_clock_is_moved(place: Place, run: Loaded) -> None:
    now = time.time()
    run.until(lambda: run.newest("launcher", "time") > now)  # its metrics may be late after what killed Redis
    restarts = run.newest("launcher", "restarts")
    for hour in HOURS:
        set_clock(place.folder, hour)
        run.until(lambda hour=hour: hours_away(run) == hour)
        run.until_all_go_on()
    assert run.newest("launcher", "restarts") == restarts


def test_an_actor_stands_still_and_is_replaced(run: Loaded) -> None:
    row = freeze(run, "actor-0", 1, 1.0)
    assert row.passed, row


@root
@pytest.mark.long  # chaos at length has it, too
def test_the_log_of_redis_has_no_room(place: Place, run: Loaded) -> None:
    with filled(place.disks["log"]):
        cannot_log(run, place.redis)
    run.until_all_go_on()


@root
@pytest.mark.long
def test_a_checkpoint_has_no_room(place: Place, run: Loaded) -> None:
    checkpoints = CheckpointFolder(run.folder / "checkpoints")
    with filled(place.disks["run"]):
        goes_on_unsaved(run)  # one that was being written when the disk filled may still have made room for the next
        before = checkpoints.numbers()
        goes_on_unsaved(run)
        assert checkpoints.numbers() == before
    run.until(lambda: checkpoints.numbers() > before)
    assert all(line.endswith("}") for line in (run.folder / "metrics.jsonl").read_text().splitlines())


def test_the_learner_stands_still(run: Loaded) -> None:
    learner = run.process_of("learner")
    learner.suspend()
    row = judged("learner stopped", run, 7.0, MOST_GROWTH)
    learner.resume()
    run.until_all_go_on()
    assert row.passed, row


@pytest.mark.long
def test_the_learner_stands_still_and_is_replaced(run: Loaded) -> None:
    row = freeze(run, "learner", 1, 1.0)
    assert row.passed, row


def test_all_are_killed_at_once_and_nothing_was_ever_lost(place: Place, run: Loaded) -> None:
    run.kill_all()
    reported = {name: run.newest("replay", name) for name in ("env_steps", "windows", "drawn_steps", "draws")}
    with place.start() as again:
        again.witness.acks = run.witness.acks
        again.begin()
        again.until_all_go_on()
        again.until(lambda: again.newest("replay", "windows") > 300)
        assert all(again.newest("replay", name) >= value for name, value in reported.items())
        verdict = again.end()
    assert again.process.returncode == 130
    assert all(one["same"] for one in again.events("resumed"))
    assert went_back(run.witness.versions + again.witness.versions) == run.witness.acks_went_back == 0
    assert (verdict.lost, verdict.duplicated) == (0, 0)
    assert verdict.acknowledged > 300


def test_a_bit_of_a_checkpoint_is_flipped(tmp_path: Path) -> None:
    checkpoints = CheckpointFolder(tmp_path / "checkpoints")
    for number in (1, 2):
        checkpoints.save(number, {"learner.pt": os.urandom(9_000), "policy.safetensors": os.urandom(700)})
    row = spoil_each(50, checkpoints, tmp_path / "copy")
    assert row.passed, row


def updates_in(run: Loaded, seconds: float) -> int:
    """Of the learner, as its metrics tell it."""
    before = run.newest("learner", "updates")
    time.sleep(seconds)
    return int(run.newest("learner", "updates") - before)


def test_a_full_ring_wraps(full: Loaded) -> None:
    full.until(lambda: full.newest("learner", "stale_state_stored"))  # for which it opens a connection, once
    row = soaked(full, 8.0, 2.0, MOST_GROWTH, EARLY_RATIO, every=1.0)
    assert row.passed, row


def test_the_replay_server_is_killed_at_every_commit_point(full: Loaded) -> None:
    strike_everywhere(full)
    assert tree_is_its_rebuild(full)


@pytest.mark.long
def test_a_learner_becomes_ten_times_slower(full: Loaded) -> None:
    usual = updates_in(full, 5.0)
    full.slow_down(SLOWER)
    assert updates_in(full, 5.0) < usual / 2
    row = judged("learner 10 times slower", full, 7.0, MOST_GROWTH)
    full.slow_down(1.0)
    assert row.passed, row


@pytest.mark.long
def test_the_replay_server_stands_still_and_is_replaced(full: Loaded) -> None:
    row = freeze(full, "replay", 1, 1.0)
    assert row.passed, row


def test_of_a_full_ring_nothing_was_lost_but_by_age(full: Loaded) -> None:
    full.until(lambda: full.newest("replay", "ring_fill") == 1.0)
    verdict = full.end()
    assert (verdict.lost, verdict.duplicated, full.witness.acks_went_back) == (0, 0, 0)
    assert verdict.acknowledged > 600  # it went round
