"""What a launcher on Ray decides, without a cluster."""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("ray")

from rmc.common.errors import BusUnavailable, ConfigError, RoleDied
from rmc.common.process.role import StopSignal
from rmc.deploy.local.role_command import RoleCommand
from rmc.deploy.ray import cluster_runs
from rmc.deploy.ray import hosts as ray_hosts
from rmc.deploy.ray import launcher as ray_launcher
from rmc.deploy.ray import run as ray_run
from rmc.deploy.ray.hosts import Hosts
from rmc.deploy.ray.placement import RolePlacement
from rmc.deploy.ray.role_actor import RoleActor
from rmc.deploy.ray.run import ClusterRun
from rmc.deploy.run.folder import RunFolder
from tests.raising import raising
from tests.runs import untrained


class Handle(SimpleNamespace):
    """An actor's host, as the launcher sees it."""


def exchanges(monkeypatch: pytest.MonkeyPatch, running: str, cluster: float) -> Callable[[], list[str]]:
    """One look at actors of which 1 runs and 0 has waited for two minutes: names of those that are ended."""
    waits = time.monotonic() - 120.0
    actors = [Handle(name=f"actor-{i}", running=one == "1", waits_since=waits) for i, one in enumerate(running)]
    run, ended = ClusterRun.__new__(ClusterRun), list[str]()

    def end(one: Handle) -> None:
        actors.remove(one)
        ended.append(one.name)

    run.config = SimpleNamespace(actors=len(running))  # type: ignore[assignment]
    run.hosts = SimpleNamespace(actors=lambda: actors, end=end)  # type: ignore[assignment]
    monkeypatch.setattr(ray_run, "cpus", lambda: cluster)
    monkeypatch.setattr(ray_run, "reserved_cpus", lambda _: 2)

    def look() -> list[str]:
        run._keep_low_actors()
        return ended

    return look


@pytest.mark.parametrize(
    ("running", "cluster", "ended"),
    [
        ("0111", 100.0, ["actor-3"]),  # another run has the CPU of actor-0
        ("0010", 3.0, ["actor-2"]),  # the highest waits, too
        ("1100", 4.0, []),  # none that runs is above one that waits
        ("1111", 100.0, []),
    ],
)
def test_the_lowest_actors_run(monkeypatch: pytest.MonkeyPatch, running: str, cluster: float, ended: list[str]) -> None:
    look = exchanges(monkeypatch, running, cluster)
    assert look() == ended
    assert look() == ended  # one at a time


@pytest.mark.parametrize("over", [True, False])
def test_a_run_is_over_by_the_rule_of_a_local_one(
    over: bool, folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, closed = folder.config(), list[bool]()
    hosts, nothing = SimpleNamespace(restarts=dict, waiting=dict, finished=lambda: True), lambda *_: None
    run = SimpleNamespace(config=config, hosts=hosts, bus=None, start=nothing, stop=nothing, close=closed.append)
    monkeypatch.setattr(ray_run, "ClusterRun", lambda *_: run)
    monkeypatch.setattr(ray_run, "is_over", lambda *given: given[1:] == (folder, True, config.total_steps) and over)
    monitor: Any = SimpleNamespace(watch=nothing)
    assert ray_run.train(config, folder, "cpu", False, False, monitor, StopSignal()) == over
    assert closed == [over]


def test_a_redis_that_is_away_is_asked_again_to_stop(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_run, "TICK_SECONDS", 0.01)
    run, asked = ClusterRun.__new__(ClusterRun), list[str]()

    def request_stop(reason: str) -> None:
        asked.append(reason)
        if len(asked) < 3:
            raise BusUnavailable("away")

    run._folder, run.bus = folder, SimpleNamespace(request_stop=request_stop)  # type: ignore[assignment]
    ended = iter([False] * 5 + [True])
    run.hosts = SimpleNamespace(tell_stop=lambda: None, all_ended=lambda: next(ended))  # type: ignore[assignment]
    run._redis = SimpleNamespace(end=lambda: None)  # type: ignore[assignment]
    run.stop("stopped")
    assert asked == ["stopped"] * 3


def test_a_port_that_a_run_has_is_not_written_again(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk would end a launcher that Ray has started again."""
    port, _ = ray_run._port(folder, "127.0.0.1")

    monkeypatch.setattr(ray_run, "write_whole", raising(OSError(28, os.strerror(28))))
    assert ray_run._port(folder, "127.0.0.1") == (port, False)


@pytest.mark.parametrize("damaged", ["638063806380", "-1", "80", "638"])
def test_a_note_of_a_port_that_is_damaged_is_none(folder: RunFolder, damaged: str) -> None:
    (folder.path / "redis-port").write_text(damaged)
    port, moved = ray_run._port(folder, "127.0.0.1")
    assert ray_run.FIRST_PORT <= port <= ray_run.LAST_PORT
    assert not moved


@pytest.fixture
def hosts(tmp_path: Path) -> Hosts:
    """Of a run that has none yet."""
    folder = untrained(tmp_path / "run")
    return Hosts(folder, "cpu", False, lambda role: f"redis://{role}")


@pytest.mark.parametrize(
    ("why", "ends"),
    [
        ("OSError: [Errno 28] No space left on device", False),
        ("BlockingIOError: [Errno 11] Resource temporarily unavailable", False),
        ("RuntimeError: can't start new thread", False),
        ("killed", True),
    ],
)
def test_a_host_whose_node_has_no_room_or_process_now_is_tried_again(
    hosts: Hosts, why: str, ends: bool, caplog: pytest.LogCaptureFixture
) -> None:
    def lose() -> None:
        one: Any = Handle(name="actor-0", dead=why)
        hosts._handles["actor-0"] = one
        hosts._forget_dead(one)

    for _ in range(ray_hosts.QUICK_DEATHS - 1):
        lose()
    if ends:
        with pytest.raises(RoleDied, match="the host of actor-0 could not be held"):
            lose()
    else:
        lose()
    assert not hosts._handles
    assert len(caplog.messages) == (ray_hosts.QUICK_DEATHS if ends else 1)


def test_a_run_whose_folder_is_damaged_is_told_and_can_be_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray gives an error of the launcher's, too, as one of its own."""
    damaged, asked = ConfigError("RUN", "/runs/a", "config.json is damaged"), list[str]()

    def get(question: str, timeout: float) -> float:
        asked.append(question)
        if question == "summary":
            raise ray_run.ray.exceptions.RayTaskError("summary", "", damaged).as_instanceof_cause()
        return timeout

    asks = {name: SimpleNamespace(remote=partial(str, name)) for name in ("summary", "end")}
    launcher = SimpleNamespace(**asks)
    monkeypatch.setattr(cluster_runs, "_launchers", lambda: {"a-1": launcher})
    monkeypatch.setattr(cluster_runs.ray, "get", get)
    with pytest.raises(ConfigError) as raised:
        cluster_runs.stop("a")
    assert raised.value is damaged
    assert asked == ["summary", "end"]
    assert cluster_runs.summaries() == {"a-1": None}
    assert asked == ["summary", "end", "summary"]


def test_a_second_start_is_told_that_the_run_is_trained(folder: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    held = list[bool]()

    def remote(*_: object) -> None:
        held.append(folder.lock.trainer() is not None)
        raise ray_launcher.ray.exceptions.ActorAlreadyExistsError("the name is taken")

    context = SimpleNamespace(gcs_address="", get_node_id=lambda: "0" * 56)
    monkeypatch.setattr(ray_launcher.ray, "get_runtime_context", lambda: context)
    options = SimpleNamespace(options=lambda **_: SimpleNamespace(remote=remote))
    monkeypatch.setattr(ray_launcher.ray, "remote", lambda _: options)
    folder.lock.take()
    with pytest.raises(ConfigError, match=r"^--run-dir=.*: this run is being trained; rmc attach watches it$"):
        ray_launcher.launch(folder.config(), folder)
    assert (held, folder.lock.trainer()) == ([True], None)


class Host:
    """Of a role, with what it was asked; it answers the first report after three looks."""

    def __init__(self, asked: list[str]) -> None:
        self.report, self.looks, self.running = None, 0, False
        self.handle = SimpleNamespace(
            **{name: SimpleNamespace(remote=partial(self._note, asked, name)) for name in ("stopping", "close")}
        )
        self.name, self.awaited = "learner", False

    def _note(self, asked: list[str], name: str, *_: object) -> str:
        asked.append(name)
        return name

    def ask(self, _: Path) -> None:
        self.looks += 1
        if self.looks == 3:
            self.report, self.running, self.awaited = object(), True, True


def test_a_launcher_that_has_just_begun_tells_living_roles_that_the_run_ends(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[str]()
    hosts._handles["learner"] = Host(asked)  # type: ignore[assignment]
    monkeypatch.setattr(ray_hosts.ray, "wait", lambda *_, **__: None)
    hosts.tell_stop()
    assert asked == ["stopping"]
    assert not hosts.all_ended()


def test_an_actor_that_makes_room_ends_with_what_its_environments_started(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[str]()
    monkeypatch.setattr(
        ray_hosts.ray, "wait", lambda replies, **_: asked.extend(f"waited for {one}" for one in replies)
    )
    monkeypatch.setattr(ray_hosts.ray, "kill", lambda *_, **__: asked.append("kill"))
    for running in (True, False):
        one: Any = Host(asked)
        one.running = running
        hosts._handles["learner"] = one
        hosts.end(one)
    assert asked == ["close", "waited for close", "kill", "kill"]
    assert not hosts._handles


def test_sigterm_while_ray_is_joined_stops_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_launcher.ray, "init", raising(SystemExit(15)))
    with pytest.raises(KeyboardInterrupt), ray_launcher.joined("local"):
        pass


def test_a_launcher_may_lose_its_working_folder(hosts: Hosts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    remote = SimpleNamespace(options=lambda **_: SimpleNamespace(remote=made.append))
    monkeypatch.setattr(ray_hosts.ray, "remote", lambda _: remote)
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    hosts._create("actor-0", RolePlacement(RoleActor, RoleCommand("actor-0", ("actor",)), 1.0, 0.0, ""))
    assert [task.working_folder for task in made] == ["/"]
