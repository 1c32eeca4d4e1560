"""A run stays known in a Redis that forgets."""

import dataclasses
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import redis
from gymnasium.spaces import Box
from rich.console import Console

from rmc.common.bus.protocol import Ack, EntryId, ReplayOwner
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.checkpoint import CheckpointFolder
from rmc.common.env.config import EnvConfig
from rmc.common.errors import BusUnavailable, ConfigError
from rmc.common.process.role import STOP_LOOKS, STOP_PERIOD, StopSignal
from rmc.common.replay import ObservationStatistics
from rmc.deploy.local import launcher
from rmc.deploy.local.role_context import RoleContext
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.redis import connect, registration
from rmc.deploy.redis.registration import Registration
from rmc.deploy.redis.run_redis import RunRedis
from rmc.deploy.run.config import from_registration, to_registration
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.presets import debug
from rmc.replay_server.commit_record import Progress
from tests import habits
from tests.raising import raising
from tests.replay_server.support import SPEC

CONFIG = debug(EnvConfig("Pendulum-v1"))
USUAL_LOOK_SECONDS = registration.LOOK_SECONDS
COUNTED = Progress(ObservationStatistics.none(SPEC), env_steps=7).publish()


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "LOOK_SECONDS", 0.0)


def test_a_redis_that_forgot_is_told_again_what_it_must_know(tmp_path: Path, redis_url: str, run_name: str) -> None:
    bus = RedisBus(redis_url, run_name)
    registered = Registration(CONFIG, RunFolder(tmp_path), bus)
    bus.commit(ReplayOwner("replay", bus.take_epoch("replay")), {0: Ack(EntryId(1, 0), 0)}, COUNTED)
    registered.end()
    _forget(redis_url, run_name)
    assert bus.config() is None
    registered.tend()
    assert from_registration(bus.config() or b"") == CONFIG
    assert bus.progress("replay") == COUNTED
    bus.request_stop("so it shall be")  # which is no reason to begin afresh
    registered.tend()
    assert bus.stop_requested() == "so it shall be"


def test_a_redis_that_came_back_with_what_it_knew_before_is_told_again(
    tmp_path: Path, redis_url: str, run_name: str
) -> None:
    """As one that is restored from a snapshot of before the run went on: sooner than a role believes in its stop."""
    assert USUAL_LOOK_SECONDS + launcher.TICK_SECONDS < (STOP_LOOKS - 1) * STOP_PERIOD
    bus = RedisBus(redis_url, run_name)
    registered = Registration(CONFIG, RunFolder(tmp_path), bus)
    bus.set_config(to_registration(dataclasses.replace(CONFIG, actors=7)))
    bus.request_stop("stopped by its launcher")
    registered.tend()
    assert from_registration(bus.config() or b"") == CONFIG
    assert bus.stop_requested() is None


def test_the_stop_of_a_start_before_does_not_end_this_one(tmp_path: Path, redis_url: str, run_name: str) -> None:
    """Where nothing has changed since, and Redis comes back as it was after the former end."""
    bus, folder = RedisBus(redis_url, run_name), RunFolder(tmp_path)
    Registration(CONFIG, folder, bus)
    bus.request_stop("stopped by its launcher")
    before = bus.config()
    assert before is not None
    registered = Registration(CONFIG, folder, bus)
    bus.set_config(before)
    bus.request_stop("stopped by its launcher")
    registered.tend()
    assert bus.stop_requested() is None


def test_a_redis_that_forgets_the_stop_is_told_again(
    tmp_path: Path, redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, stop = RunFolder(tmp_path), StopSignal()
    folder.write_config(CONFIG)
    bus, monitor, looks = RedisBus(redis_url, folder.name), Monitor(folder, CONFIG, Console(quiet=True)), []

    def forgotten(_: object) -> None:
        looks.append(bus.stop_requested())
        bus.clear_stop()

    monkeypatch.setattr(launcher, "STOP_SECONDS", 2.0)
    monkeypatch.setattr(monitor, "watch", forgotten)
    stop.request()
    assert not launcher.attend(CONFIG, folder, redis_url, monitor, stop)
    assert len(looks) > 2
    assert set(looks) == {"stopped by its launcher"}
    monitor.close()


def test_a_run_started_by_hand_is_told_to_stop_once_redis_takes_it(
    tmp_path: Path, redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, stop, request_stop, tries = CONFIG, StopSignal(), RedisBus.request_stop, [3]

    def away(bus: RedisBus, reason: str) -> None:
        tries[0] -= 1
        if tries[0] >= 0:
            raise BusUnavailable("gone again")
        request_stop(bus, reason)

    monkeypatch.setattr(RedisBus, "request_stop", away)
    folder = RunFolder(tmp_path)
    folder.write_config(config)
    bus, monitor = RedisBus(redis_url, folder.name), Monitor(folder, config, Console(quiet=True))
    bus.emit("learner", {"finished": 1, "checkpoint_update": 40})
    monkeypatch.setattr(monitor, "skip_old", lambda _: None)
    with pytest.raises(ConfigError, match="the learner's last checkpoint, of update 40, is not there"):
        launcher.attend(config, folder, redis_url, monitor, stop)  # it is on the learner's machine
    CheckpointFolder(folder.checkpoints).save(40, {"policy.safetensors": b"weights"})
    assert launcher.attend(config, folder, redis_url, monitor, stop)
    assert bus.stop_requested() == "finished"
    monitor.close()


def test_a_run_started_by_hand_whose_launcher_fails_is_stopped_and_leaves_nothing_in_redis(
    tmp_path: Path, redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder(tmp_path)
    folder.write_config(CONFIG)
    bus, monitor = RedisBus(redis_url, folder.name), Monitor(folder, CONFIG, Console(quiet=True))
    monkeypatch.setattr(monitor, "watch", raising(ConfigError("--run-dir", "", "was deleted or moved")))
    with pytest.raises(ConfigError, match="was deleted or moved"):
        launcher.attend(CONFIG, folder, redis_url, monitor, StopSignal())
    assert bus.stop_requested() == "stopped by its launcher"
    assert {bus.redis.ttl(bus.key(name)) > 0 for name in ("config", "stop")} == {True}
    monitor.close()


def test_a_redis_that_is_away_for_a_moment_ends_no_start(
    tmp_path: Path, redis_url: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As a network resets a connection right after it was tried. What is amiss in the folder is told once."""
    expire, moments = RedisBus.expire, [2, 10**9]

    def away(bus: RedisBus, seconds: int | None) -> None:
        moments[0] -= 1
        if moments[0] >= 0:
            raise BusUnavailable("reset by peer")
        expire(bus, seconds)

    monkeypatch.setattr(RedisBus, "expire", away)
    folder = RunFolder(tmp_path)
    (tmp_path / "replay-counters").write_bytes(b"damaged")
    stop = StopSignal()
    with closing(RunRedis(CONFIG, folder, stop, redis_url)) as own:
        assert from_registration(own.bus.config() or b"") == CONFIG
    assert caplog.text.count("replay-counters: cannot be read") == 1
    monkeypatch.setattr(connect, "AWAY_SECONDS", 0.5)
    moments.pop(0)
    with pytest.raises(BusUnavailable, match="reset by peer"):
        RunRedis(CONFIG, folder, stop, redis_url)
    monkeypatch.setattr(connect, "AWAY_SECONDS", 600.0)
    stop.requested = True  # Ctrl-C
    with pytest.raises(KeyboardInterrupt):
        RunRedis(CONFIG, folder, stop, redis_url)


def test_a_redis_that_is_away_is_told_later(
    tmp_path: Path, redis_url: str, run_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = RedisBus(redis_url, run_name)
    registered = Registration(CONFIG, RunFolder(tmp_path), bus)
    _forget(redis_url, run_name)

    with monkeypatch.context() as patched:
        patched.setattr(bus, "set_config", raising(BusUnavailable("gone again")))
        registered.tend()
    assert bus.config() is None
    registered.tend()
    assert bus.config() is not None


def test_a_role_whose_environment_has_other_sizes_than_the_launchers_does_not_begin(
    tmp_path: Path, redis_url: str, run_name: str
) -> None:
    bus, config = RedisBus(redis_url, run_name), debug(EnvConfig("tests.habits:Slide-v0"))
    Registration(config, RunFolder(tmp_path), bus)
    role = RoleContext.__new__(RoleContext)
    role.config = from_registration(bus.config() or b"")
    assert role.config == config
    role.make_env().close()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(habits.Slide, "observation_space", Box(-99.0, 99.0, (4,), np.float32))
        with pytest.raises(ConfigError, match="the environment now has 4 observations, the run was trained with 3"):
            role.make_env()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (3, "layout=3: must be an object"),
        (None, "layout=None: must be an object"),
        ({"frames": "1"}, "layout frames='1'"),
        ({"frames": 0}, "layout frames=0"),
        ({"actions": []}, "layout actions"),
        ({"observations": [{"name": "", "start": 1, "stop": 3, "shape": [2], "dtype": "float32"}]}, "layout obs"),
        ({"observations": [{"name": "", "start": 0, "stop": 3, "shape": [2], "dtype": "float32"}]}, "layout obs"),
        ({"action_low": [9.0]}, "layout action_low"),
        ({"action_low": [float("nan")]}, "layout action_low"),
        ({"action_high": []}, "layout action_low"),
        ({"time_limit": 1.5}, "layout time_limit"),
    ],
)
def test_a_layout_that_is_none_is_refused(change: object, named: str) -> None:
    registered = json.loads(to_registration(CONFIG))
    registered["layout"] = registered["layout"] | change if isinstance(change, dict) else change
    with pytest.raises(ConfigError, match=named):
        from_registration(json.dumps(registered).encode())


def _forget(redis_url: str, run_name: str) -> None:
    server = redis.Redis.from_url(redis_url)
    for key in server.scan_iter(f"rmc:{run_name}:*"):
        server.delete(key)
    server.close()
