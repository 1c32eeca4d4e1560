"""A run on Ray: the roles of ``deploy/local/launcher.py`` as named, detached actors on the nodes of a cluster.

Ray core starts again what dies, here or elsewhere. The launcher is such an actor itself, on the head, beside
the run's Redis and folder; it places the others, gives new nodes actors, and hears why a role died.
Learner, evaluator and a single replay server share a node; actors take a CPU each, anywhere.
"""

import dataclasses
import logging
import socket
import time
import zlib
from contextlib import suppress

import ray

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import BusFull, BusUnavailable, ConfigError
from rmc.common.process.role import StopSignal
from rmc.common.whole_file import write_whole
from rmc.deploy.local.launcher import TICK_SECONDS, asked_to_stop, is_over
from rmc.deploy.local.supervisor import HELD_SECONDS
from rmc.deploy.monitor.monitor import Monitor
from rmc.deploy.ray.hosts import Hosts
from rmc.deploy.ray.placement import (
    actors_in_the_way,
    cpus,
    free_cpus,
    free_resources,
    groups,
    reserved_cpus,
    whole_shares,
)
from rmc.deploy.ray.role_actor import actor_name
from rmc.deploy.ray.waiting_groups import WaitingGroups
from rmc.deploy.redis.run_redis import RunRedis
from rmc.deploy.redis.server import Port
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder

NODES_SECONDS = 2.0  # between looks for nodes that came
PENDING_SECONDS = 8.0  # without a node for the learner or a replay server, after which actors make room
STARTING_SECONDS = 60.0  # of an actor without a CPU, where there is one for each: another run may have its own
GIVE_WAY_SECONDS = 300.0  # without a node for those of another run, after which actors are placed all the same
STOP_SECONDS = 20.0  # for all roles to end cleanly and for the last checkpoint to reach the head
FIRST_PORT, LAST_PORT = 6380, 6479  # for Redis; 6379 is Ray's
log = logging.getLogger(__name__)


class ClusterRun:
    """A run's roles on Ray between ``start`` and ``close``. Ray must be connected."""

    def __init__(
        self, config: RunConfig, folder: RunFolder, device: str, all_cpus: bool, encrypted: bool, stop: StopSignal
    ) -> None:
        self.config, self._folder, self._device, self._all_cpus = config, folder, device, all_cpus
        ip = ray.util.get_node_ip_address()
        if encrypted:
            tls.make_certificate(folder.path, ip)
        number, self._moved = _port(folder, ip)
        self._redis = RunRedis(config, folder, stop, port=Port(ip, number, folder.path if encrypted else None))
        self.bus = self._redis.bus
        self.hosts = Hosts(folder, device, encrypted, self._url)
        self._look_at = 0.0
        self._waiting = WaitingGroups()

    def _url(self, role: str) -> str:
        return self._redis.server.network_url(role, f"{{scratch_url}}/{tls.CERTIFICATE}")

    def start(self) -> None:
        """Place every role, or find again those that an earlier launcher of the run has placed."""
        if self._moved:
            self.hosts.end_left(self.config)
        self.hosts.start(self.config)

    def tend(self) -> None:
        """Hear every host, and place what is not. Raises RoleDied."""
        self._redis.tend()
        self.hosts.ask()
        if time.monotonic() >= self._look_at:
            self._look_at = time.monotonic() + NODES_SECONDS
            self._look_at_nodes()

    def _look_at_nodes(self) -> None:
        needs = groups(self.config, self._device)
        waiting, own = self._waiting.look(), {actor_name(self._folder.name, role): role for role in needs}
        first = [seconds for name, seconds in waiting.items() if name in own or seconds < GIVE_WAY_SECONDS]
        if not first:
            self.hosts.place(self.config)
            if self._all_cpus and not self.hosts.waiting():
                self._grow()
            self._keep_low_actors()
        elif max(first) >= NODES_SECONDS:  # it has not only begun
            self._end_waiting_actors()
            overdue = [name for name in own if waiting.get(name, 0.0) >= PENDING_SECONDS]
            for name in overdue[:1]:  # of the next the cluster has another view
                self._waiting.count_anew(name)
                self._make_room(own[name], needs[own[name]])

    def _keep_low_actors(self) -> None:
        """Where CPUs are lost, it is the highest actors that wait: the run's last steps go to the lowest."""
        lost = cpus() < reserved_cpus(self.config) + self.config.actors
        overdue = time.monotonic() - (PENDING_SECONDS if lost else STARTING_SECONDS)
        actors = self.hosts.actors()
        waiting = [number for number, one in enumerate(actors) if not one.running and one.waits_since < overdue]
        higher = [one for one in actors[waiting[0] :] if one.running] if waiting else []
        if higher:
            log.warning("%s waits for a CPU; %s gives it its own", actors[waiting[0]].name, higher[-1].name)
            actors[waiting[0]].waits_since = time.monotonic()  # one exchange at a time
            self.hosts.end(higher[-1])

    def _end_waiting_actors(self) -> None:
        """They would take the CPUs that become free for a learner or replay server, of this run or another."""
        waiting = [one for one in self.hosts.actors() if not one.running]
        for one in waiting:
            self.hosts.end(one)
        if waiting:
            names = ", ".join(one.name for one in waiting)
            log.warning("a learner or replay server has no node; ended until it has: %s", names)

    def _make_room(self, role: str, need: dict[str, float]) -> None:
        """End as few running actors as let the role fit on a node; none where all of them are too few."""
        actors = self.hosts.actors()
        plans = [actors_in_the_way(need, node, free, actors) for node, free in free_resources()]
        going = min((plan for plan in plans if plan is not None), key=len, default=None)
        if going is None:
            fix = "start a node, or stop another run"
            log.warning("no node has room for %s, even without actors of this run; it needs %s; %s", role, need, fix)
        for one in going or []:
            log.warning("no node has room for %s; %s is ended for it", role, one.name)
            self.hosts.end(one)

    def _grow(self) -> None:
        """Give CPUs that came an actor each; the replay servers start again to know of them."""
        room = int(cpus() - reserved_cpus(self.config))  # what is free may be an old view of it
        fit = whole_shares(min(self.config.actors + free_cpus(), room), self.config)
        if fit <= self.config.actors:
            return
        grown = dataclasses.replace(self.config, actors=fit)
        try:
            self._folder.write_config(grown)
            self._redis.change(grown)
        except (BusUnavailable, BusFull, OSError):  # the next look tries again
            return
        self.config = grown
        self.hosts.restart_replay()
        self.hosts.place(grown)

    def stop(self, reason: str) -> None:
        """Ask every role to end, and wait until the learner's last checkpoint is on the head."""
        self.hosts.tell_stop()
        deadline, asked = time.monotonic() + STOP_SECONDS + self._patience(0.0), False
        while time.monotonic() < deadline and not self.hosts.all_ended():
            asked = asked or asked_to_stop(self.bus, reason)  # a Redis that is away is asked again
            time.sleep(TICK_SECONDS)
        self._redis.end()

    def _patience(self, least: float) -> float:
        """The seconds that the learner has to save, which are none of those in which a small state is on the head."""
        return CheckpointFolder(self._folder.checkpoints).patience(least)

    def close(self, over: bool) -> None:
        """End everything; nothing is left but the run's folder and, on its node, the ring of a run that may go on."""
        try:
            self.hosts.close(over, self._patience(HELD_SECONDS))
        finally:
            self._redis.close()


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
    run = ClusterRun(config, folder, device, all_cpus, encrypted, stop)
    monitor.restarts, monitor.unplaced = run.hosts.restarts, run.hosts.waiting
    monitor.roles = lambda: run.config.roles()
    over = False
    try:
        run.start()
        while not stop.requested and not run.hosts.finished():
            run.tend()
            monitor.watch(run.bus)
            time.sleep(TICK_SECONDS)
        run.stop("stopped by its launcher" if stop.requested else "finished")
        monitor.watch(run.bus)  # what the roles said last
        ended = run.hosts.finished() and not stop.requested  # one that was stopped has ended cleanly, too
        over = is_over(monitor, folder, ended, run.config.total_steps)
        return over
    finally:
        run.close(over)


def _port(folder: RunFolder, ip: str) -> tuple[int, bool]:
    """A port for the run's Redis, and whether it had another before, which is taken now."""
    note = folder.path / "redis-port"
    ports, had = list(range(FIRST_PORT, LAST_PORT + 1)), None
    with suppress(OSError, ValueError):  # there is none, or it is damaged
        had = noted if (noted := int(note.read_text())) in ports else None
    own = zlib.crc32(folder.name.encode()) % len(ports)  # runs that begin together do not want the same
    candidates = [*([had] if had else []), *ports[own:], *ports[:own]]
    for port in candidates:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((ip, port))
            except OSError:
                continue
            if port != had:  # on a full disk it may stay as it is
                write_whole(note, f"{port}\n".encode())
            return port, had not in (None, port)
    raise ConfigError("--launcher", "ray", f"no port from {FIRST_PORT} to {LAST_PORT} is free on {ip} for Redis")
