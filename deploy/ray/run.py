"""A run on Ray: the roles of ``deploy/local/launcher.py`` as named, detached actors on the nodes of a cluster.

Ray core starts again what dies, here or elsewhere. The launcher is such an actor itself, on the head, beside
the run's Redis and folder; it places the others, gives new nodes actors, and hears why a role died.
Learner, evaluator and a single replay server share a node; actors take a CPU each, anywhere.
"""

import dataclasses
import logging
import os
import socket
import time
import zlib
from contextlib import ExitStack, suppress
from typing import Any

import ray
from ray.util.placement_group import placement_group, remove_placement_group
from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import BusFull, BusUnavailable, ConfigError, RoleDied
from rmc.common.process.role import StopSignal
from rmc.common.shard import WHOLE
from rmc.common.whole_file import write_whole
from rmc.deploy.local.launcher import TICK_SECONDS
from rmc.deploy.local.role_environment import URL_VARIABLE
from rmc.deploy.local.socket_folder import SocketFolder
from rmc.deploy.local.supervisor import QUICK_DEATHS
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.ray.placement import (
    SHARD_CPUS,
    RolePlacement,
    actors_in_the_way,
    bundle,
    cpus,
    free_cpus,
    free_resources,
    places,
    reserved_cpus,
    whole_shares,
)
from rmc.deploy.ray.ring_nodes import RingLocations
from rmc.deploy.ray.role_actor import NAMESPACE, Task, actor_name
from rmc.deploy.ray.role_handle import RoleHandle
from rmc.deploy.ray.waiting_learners import WaitingLearners, learner_group
from rmc.deploy.redis.connect import PATIENCE_VARIABLE, connect
from rmc.deploy.redis.registration import Registration
from rmc.deploy.redis.server import Port, RedisServer
from rmc.deploy.redis.users import RedisUsers
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder

NODES_SECONDS = 2.0  # between looks for nodes that came
LEARNER_PENDING_SECONDS = 8.0  # without a node for the learner, after which actors make room
GIVE_WAY_SECONDS = 300.0  # without a node for another run's learner, after which actors are placed all the same
LOST_SECONDS = 120.0  # within which a role's host may be lost for good twice
STOP_SECONDS = 20.0  # for all roles to end in order and for the last checkpoint to reach the head
PATIENCE_SECONDS = 120.0  # of a role that starts while launcher and Redis are being started again
FIRST_PORT, LAST_PORT = 6380, 6479  # for Redis; 6379 is Ray's
NOTICE_SECONDS = 2.0  # for hosts to hear that the run ends
log = logging.getLogger(__name__)


class ClusterRun:
    """A run's roles on Ray between ``start`` and ``close``. Ray must be connected."""

    def __init__(self, config: RunConfig, folder: RunFolder, device: str, all_cpus: bool, encrypted: bool) -> None:
        self.config, self._folder, self._device, self._all_cpus = config, folder, device, all_cpus
        self._encrypted, self._ring_locations = encrypted, RingLocations(folder)
        self._leave = ExitStack()
        self._sockets = SocketFolder()
        self._leave.callback(self._sockets.close)
        try:
            ip = ray.util.get_node_ip_address()
            if encrypted:
                tls.make_certificate(folder.path, ip)
            number, self._moved = _port(folder, ip)
            port = Port(ip, number, folder.path if encrypted else None)
            self._server = RedisServer(self._sockets.path, port=port, users=self._users(config))
            self._leave.enter_context(self._server)
            self.bus = connect(self._server.url(), folder.name)
            self._registration = Registration(config, folder, self.bus)
        except BaseException:
            self._leave.close()
            raise
        self._hosts: dict[str, RoleHandle] = {}
        self._groups: dict[str, Any] = {}
        self._bundles: dict[str, int] = {}  # of the replay servers' group
        self._lost: dict[str, list[float]] = {}  # when hosts died for good, by role
        self._look_at = 0.0
        self._learners = WaitingLearners()

    def _users(self, config: RunConfig) -> RedisUsers:
        return RedisUsers(self._folder.name, self._folder.secret(), config.roles())

    # -- placing --------------------------------------------------------------------------------------

    def start(self) -> None:
        """Place every role, or find again those that an earlier launcher of the run has placed."""
        if self._moved:
            self._end_left_hosts()
        near = self._ring_locations.node(WHOLE.role)
        self._groups["learner"] = self._group("learner", [bundle(self.config, self._device)], "STRICT_PACK", near)
        if self.config.replay.replay_shards > 1:  # a ring stays on its node: so does its server
            roles = [shard.role for shard in self.config.shards()]
            self._groups["replay"] = self._group("replay", [{"CPU": SHARD_CPUS}] * len(roles), "SPREAD")
            self._bundles = self._ring_locations.bundles(self._groups["replay"], roles)
        self._place_all()

    def _group(self, name: str, bundles: list[dict[str, float]], strategy: str, near: str | None = None) -> Any:
        name = actor_name(self._folder.name, name)
        try:
            return ray.util.get_placement_group(name)
        except ValueError:
            return placement_group(
                bundles, strategy=strategy, name=name, lifetime="detached", _soft_target_node_id=near
            )

    def _end_left_hosts(self) -> None:
        """Those of an earlier launcher, where Redis could not have its port again: they would never find it."""
        for name in places(self.config, self._folder.name, self._device, self._encrypted):
            with suppress(ValueError):
                ray.kill(ray.get_actor(actor_name(self._folder.name, name), NAMESPACE), no_restart=True)

    def _place_all(self) -> None:
        for name, place in places(self.config, self._folder.name, self._device, self._encrypted).items():
            if name not in self._hosts:
                self._hosts[name] = RoleHandle(name, self._create(name, place), place.command.env_timeout)
                self._hosts[name].handle.stopping.remote(False)  # one that was found may have heard otherwise

    def _create(self, name: str, place: RolePlacement) -> Any:
        strategy: Any = "SPREAD"
        if place.group:
            strategy = PlacementGroupSchedulingStrategy(
                self._groups[place.group], placement_group_bundle_index=self._bundles.get(name, 0)
            )
        options = ray.remote(place.kind).options(
            name=actor_name(self._folder.name, name), namespace=NAMESPACE, lifetime="detached", get_if_exists=True,
            max_restarts=-1, num_cpus=place.cpus, num_gpus=place.gpus, scheduling_strategy=strategy,
        )  # fmt: skip
        url = self._server.network_url(name, f"{{scratch_url}}/{tls.CERTIFICATE}")
        secrets = {f"redis-url-{name}": url.encode()}  # roles on one node share its scratch folder
        if name == "learner" or name.startswith("replay"):
            secrets["secret"] = self._folder.secret()
        if self._encrypted:
            files = (tls.CERTIFICATE, tls.KEY) if name.startswith("replay") else (tls.CERTIFICATE,)
            secrets |= {file: (self._folder.path / file).read_bytes() for file in files}
        environment = {URL_VARIABLE: f"file:{{scratch}}/redis-url-{name}", PATIENCE_VARIABLE: str(PATIENCE_SECONDS)}
        return options.remote(Task(self._folder.name, place.command, environment, secrets, os.getcwd()))

    # -- tending --------------------------------------------------------------------------------------

    def tend(self) -> None:
        """Hear every host, and place what is not. Raises RoleDied."""
        self._sockets.renew()
        self._server.tend()
        self._registration.tend()
        for role_handle in list(self._hosts.values()):
            role_handle.ask(self._folder.logs)
            if role_handle.dead:
                self._forget_dead(role_handle)
            elif role_handle.name.startswith("replay") and role_handle.running:
                self._ring_locations.note(role_handle.name, role_handle.node)
        if time.monotonic() >= self._look_at:
            self._look_at = time.monotonic() + NODES_SECONDS
            self._look_at_nodes()

    def _forget_dead(self, role_handle: RoleHandle) -> None:
        """Let go of a host that Ray does not start again; the next look at the nodes makes another."""
        log.warning("the host of %s is gone: %s", role_handle.name, role_handle.dead)
        del self._hosts[role_handle.name]
        now = time.monotonic()
        lost = [when for when in self._lost.get(role_handle.name, []) if now - when < LOST_SECONDS]
        self._lost[role_handle.name] = [*lost, now]
        if len(lost) + 1 >= QUICK_DEATHS:
            raise RoleDied(f"the host of {role_handle.name} could not be held:\n{role_handle.dead}")

    def _look_at_nodes(self) -> None:
        waiting, own = self._learners.look(), learner_group(self._folder.name)
        first = [seconds for name, seconds in waiting.items() if name == own or seconds < GIVE_WAY_SECONDS]
        if not first:
            self._place_all()
            if self._all_cpus and not self.waiting():
                self._grow()
            self._keep_low_actors()
        elif max(first) >= NODES_SECONDS:  # it has not only begun
            self._end_waiting_actors()
            if waiting.get(own, 0.0) >= LEARNER_PENDING_SECONDS:
                self._learners.count_anew(own)
                self._make_room()

    def _keep_low_actors(self) -> None:
        """Where CPUs are lost for good, it is the highest actors that wait: the run's last steps go to the lowest."""
        if cpus() >= reserved_cpus(self.config) + self.config.actors:  # they are only being started again
            return
        actors = self._actors()
        overdue = time.monotonic() - LEARNER_PENDING_SECONDS
        waiting = [one for one in actors if not one.running and one.waits_since < overdue]
        if waiting and actors[-1].running:
            log.warning("%s waits for a CPU; %s gives it its own", waiting[0].name, actors[-1].name)
            self._end_host(actors[-1])

    def _end_host(self, role_handle: RoleHandle) -> None:
        ray.kill(role_handle.handle, no_restart=True)
        self._hosts.pop(role_handle.name)

    def _end_waiting_actors(self) -> None:
        """They would take the CPUs that become free for a learner, of this run or another."""
        waiting = [one for one in self._actors() if not one.running]
        for one in waiting:
            self._end_host(one)
        if waiting:
            log.warning("a learner has no node; ended until it has: %s", ", ".join(one.name for one in waiting))

    def _make_room(self) -> None:
        """End as few running actors as let the learner fit on a node; none where all of them are too few."""
        actors, need = self._actors(), bundle(self.config, self._device)
        plans = [actors_in_the_way(need, node, free, actors) for node, free in free_resources()]
        going = min((plan for plan in plans if plan is not None), key=len, default=None)
        if going is None:
            fix = "start a node, or stop another run"
            log.warning("no node has room for the learner, even without actors of this run; it needs %s; %s", need, fix)
        for one in going or []:
            log.warning("no node has room for the learner; %s is ended for it", one.name)
            self._end_host(one)

    def _actors(self) -> list[RoleHandle]:
        """Those with the lowest numbers first."""
        actors = [role_handle for name, role_handle in self._hosts.items() if name.startswith("actor-")]
        return sorted(actors, key=lambda role_handle: int(role_handle.name.removeprefix("actor-")))

    def _grow(self) -> None:
        """Give CPUs that came an actor each; the replay servers start again to know of them."""
        room = int(cpus() - reserved_cpus(self.config))  # what is free may be an old view of it
        fit = whole_shares(min(self.config.actors + free_cpus(), room), self.config)
        if fit <= self.config.actors:
            return
        grown = dataclasses.replace(self.config, actors=fit)
        try:
            self._folder.write_config(grown)
            self._registration.change(grown)
            self._server.admit(self._users(grown))
        except (BusUnavailable, BusFull, OSError):  # the next look tries again
            return
        self.config = grown
        for name, role_handle in self._hosts.items():
            if name.startswith("replay"):
                role_handle.handle.restart.remote()
        self._place_all()

    def restarts(self) -> dict[str, int]:
        """How often each role was started again."""
        return {name: role_handle.restarts for name, role_handle in self._hosts.items()}

    def waiting(self) -> list[str]:
        """Roles that run nowhere now."""
        return [name for name, role_handle in self._hosts.items() if not role_handle.running]

    def finished(self) -> bool:
        """Whether the learner has ended in order, and its last checkpoint is on the head."""
        learner = self._hosts.get("learner")
        return learner is not None and learner.report is not None and learner.report.status == 0

    # -- the end --------------------------------------------------------------------------------------

    def stop(self, reason: str) -> None:
        """Ask every role to end, and wait until the learner's last checkpoint is on the head."""
        replies = [
            role_handle.handle.stopping.remote(True) for role_handle in self._hosts.values() if role_handle.running
        ]
        if replies:
            ray.wait(replies, num_returns=len(replies), timeout=NOTICE_SECONDS)
        with suppress(BusUnavailable, BusFull):
            self.bus.request_stop(reason)
        deadline = time.monotonic() + STOP_SECONDS + self._saving()
        while time.monotonic() < deadline and any(role_handle.awaited for role_handle in self._hosts.values()):
            for role_handle in self._hosts.values():
                with suppress(RoleDied):
                    role_handle.ask(self._folder.logs)
            time.sleep(TICK_SECONDS)
        self._registration.keep()

    def _saving(self) -> float:
        """The seconds that the learner has to save, which are none of those in which a small state is on the head."""
        return CheckpointFolder(self._folder.checkpoints).patience(0.0)

    def _kept_elsewhere(self) -> bool:
        """Whether something of the run is on a node alone, where its hosts share a folder."""
        troubled = [role_handle for role_handle in self._hosts.values() if role_handle.trouble]
        for role_handle in troubled:
            log.warning("what %s left stays on %s: %s", role_handle.name, role_handle.node, role_handle.trouble)
        return bool(troubled)

    def close(self, over: bool) -> None:
        """End everything; nothing is left but the run's folder and, on its node, the ring of a run that may go on."""
        try:
            closing = [role_handle.handle.close.remote() for role_handle in self._hosts.values() if role_handle.awaited]
            if closing:
                ray.wait(closing, num_returns=len(closing), timeout=STOP_SECONDS / 2 + self._saving())
            if over and not self._kept_elsewhere():
                clearing = [
                    role_handle.handle.clear.remote()
                    for role_handle in self._hosts.values()
                    if role_handle.report is not None
                ]
                ray.wait(clearing, num_returns=len(clearing), timeout=STOP_SECONDS / 4)
            for role_handle in self._hosts.values():
                ray.kill(role_handle.handle, no_restart=True)
            for group in self._groups.values():
                remove_placement_group(group)
        finally:
            self._leave.close()


def train(
    config: RunConfig,
    folder: RunFolder,
    device: str,
    all_cpus: bool,
    encrypted: bool,
    monitor: Monitor,
    stop: StopSignal,
) -> bool:
    """Train until the total is reached or ``stop`` is set; whether it was reached. Raises RoleDied, ConfigError."""
    run = ClusterRun(config, folder, device, all_cpus, encrypted)
    monitor.restarts, monitor.unplaced = run.restarts, run.waiting
    monitor.roles = lambda: run.config.roles()
    over = False
    try:
        monitor.skip_old(run.bus)
        run.start()
        while not stop.requested and not run.finished():
            run.tend()
            monitor.watch(run.bus)
            time.sleep(TICK_SECONDS)
        run.stop("stopped by its launcher" if stop.requested else "finished")
        monitor.watch(run.bus)  # what the roles said last
        over = monitor.learner_finished()  # one that was stopped has ended in order, too
        return over
    finally:
        run.close(over)


def _port(folder: RunFolder, ip: str) -> tuple[int, bool]:
    """A port for the run's Redis, and whether it had another before, which is taken now."""
    note = folder.path / "redis-port"
    had = None
    with suppress(OSError, ValueError):  # there is none, or it is damaged
        had = int(note.read_text())
    ports = list(range(FIRST_PORT, LAST_PORT + 1))
    own = zlib.crc32(folder.name.encode()) % len(ports)  # runs that begin together do not want the same
    candidates = [*([had] if had else []), *ports[own:], *ports[:own]]
    for port in candidates:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((ip, port))
            except OSError:
                continue
            write_whole(note, f"{port}\n".encode())
            return port, had not in (None, port)
    raise ConfigError("--launcher", "ray", f"no port from {FIRST_PORT} to {LAST_PORT} is free on {ip} for Redis")
