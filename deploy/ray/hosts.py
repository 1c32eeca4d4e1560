"""The hosts of a run's roles on a Ray cluster: named, detached Ray actors, and the groups that keep their CPUs."""

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import cycle
from typing import Any

import ray
from ray.util.placement_group import placement_group, remove_placement_group
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy, PlacementGroupSchedulingStrategy

from rmc.common.errors import RoleDied
from rmc.common.shard import WHOLE
from rmc.deploy.local.role_environment import URL_VARIABLE, working_folder
from rmc.deploy.local.role_process import QUICK_DEATHS
from rmc.deploy.ray.placement import LEARNER, RolePlacement, groups, nodes_by_room, places
from rmc.deploy.ray.ring_nodes import RingLocations
from rmc.deploy.ray.role_actor import NAMESPACE, Task, actor_name, clear_scratch, is_for_now
from rmc.deploy.ray.role_handle import RoleHandle
from rmc.deploy.redis.connect import PATIENCE_VARIABLE
from rmc.deploy.run import tls
from rmc.deploy.run.config import RunConfig
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.launch_options import users_path

LOST_SECONDS = 120.0  # within which a role's host may be lost for good twice
PATIENCE_SECONDS = 120.0  # of a role that starts while launcher and Redis are being started again
CLOSE_SECONDS, CLEAR_SECONDS = 10.0, 10.0  # for hosts to end, and to remove what is left on all nodes
NOTICE_SECONDS = 2.0  # for them to hear that the run ends
HEAR_SECONDS = 0.05  # between looks for an answer
log = logging.getLogger(__name__)


class Hosts:
    """Those of one run, by role. ``url`` tells with which URL a role connects to the run's Redis."""

    def __init__(self, folder: RunFolder, device: str, encrypted: bool, url: Callable[[str], str]) -> None:
        self._folder, self._device, self._encrypted, self._url = folder, device, encrypted, url
        self._ring_locations = RingLocations(folder)
        self._handles: dict[str, RoleHandle] = {}
        self._groups: dict[str, Any] = {}
        self._lost: dict[str, list[float]] = {}  # when hosts died for good, by role
        self._short: dict[str, float] = {}  # when a node last had no room or no process for one

    def start(self, config: RunConfig) -> None:
        """Place every role, or find again those that an earlier launcher of the run has placed."""
        roomy = cycle(nodes_by_room())
        for name, need in groups(config, self._device).items():
            home = self._ring_locations.node(WHOLE.role if name == LEARNER else name)
            if home is None and name != LEARNER:
                home = next(roomy)
            self._groups[name] = self._group(name, need, home)
        self.place(config)

    def _group(self, name: str, need: dict[str, float], node: str | None) -> Any:
        """On that node if it has room, else on any."""
        name = actor_name(self._folder.name, name)
        try:
            return ray.util.get_placement_group(name)
        except ValueError:
            return placement_group(
                [need], strategy="STRICT_PACK", name=name, lifetime="detached", _soft_target_node_id=node
            )

    def _places(self, config: RunConfig) -> dict[str, RolePlacement]:
        return places(config, self._folder.name, self._device, self._encrypted)

    def end_left(self, config: RunConfig) -> None:
        """End those of an earlier launcher: they would never find a Redis that could not have its port again."""
        for name in self._places(config):
            with suppress(ValueError):
                ray.kill(ray.get_actor(actor_name(self._folder.name, name), NAMESPACE), no_restart=True)

    def place(self, config: RunConfig) -> None:
        """Give every role that has no host one."""
        for name, place in self._places(config).items():
            if name not in self._handles:
                self._handles[name] = RoleHandle(name, self._create(name, place), place.command.env_timeout)
                self._handles[name].handle.stopping.remote(False)  # one that was found may have heard otherwise

    def _create(self, name: str, place: RolePlacement) -> Any:
        strategy: Any = "SPREAD"
        if place.group:
            strategy = PlacementGroupSchedulingStrategy(self._groups[place.group], placement_group_bundle_index=0)
        options = ray.remote(place.kind).options(
            name=actor_name(self._folder.name, name), namespace=NAMESPACE, lifetime="detached", get_if_exists=True,
            max_restarts=-1, num_cpus=place.cpus, num_gpus=place.gpus, scheduling_strategy=strategy,
        )  # fmt: skip
        environment = {URL_VARIABLE: self._url(name), PATIENCE_VARIABLE: str(PATIENCE_SECONDS), **users_path()}
        secrets = self._secrets(name)
        return options.remote(Task(self._folder.name, place.command, environment, secrets, working_folder()))

    def _secrets(self, name: str) -> dict[str, bytes]:
        """Files of a role's, by name; roles on one node share the folder that they are in."""
        secrets: dict[str, bytes] = {}
        if name == "learner" or name.startswith("replay"):
            secrets["secret"] = self._folder.secret()
        if self._encrypted:
            files = (tls.CERTIFICATE, tls.KEY) if name.startswith("replay") else (tls.CERTIFICATE,)
            secrets |= {file: (self._folder.path / file).read_bytes() for file in files}
        return secrets

    def ask(self) -> None:
        """Hear every one, and let go of those that are dead. Raises RoleDied."""
        for one in list(self._handles.values()):
            one.ask(self._folder.logs)
            if one.dead:
                self._forget_dead(one)
            elif one.name.startswith("replay") and one.running:
                self._ring_locations.note(one.name, one.node)

    def _forget_dead(self, one: RoleHandle) -> None:
        """Of a host that Ray does not start again: the next ``place`` makes another.

        One whose node has no room on its disk, or no process to give, is tried until it has, and said once.
        """
        del self._handles[one.name]
        now = time.monotonic()
        said = self._short.get(one.name, float("-inf")) > now - LOST_SECONDS
        if not (is_for_now(one.dead) and said):
            log.warning("the host of %s is gone: %s", one.name, one.dead)
        if is_for_now(one.dead):
            self._short[one.name] = now
            return
        lost = [when for when in self._lost.get(one.name, []) if now - when < LOST_SECONDS]
        self._lost[one.name] = [*lost, now]
        if len(lost) + 1 >= QUICK_DEATHS:
            raise RoleDied(f"the host of {one.name} could not be held:\n{one.dead}")

    def end(self, one: RoleHandle) -> None:
        """With what its environments have started; its CPU is free for others."""
        _wait([one.handle.close.remote()] if one.running else [], CLOSE_SECONDS)
        ray.kill(one.handle, no_restart=True)
        self._handles.pop(one.name)

    def restart_replay(self) -> None:
        """Let the replay servers begin anew, with the config of now."""
        for name, one in self._handles.items():
            if name.startswith("replay"):
                one.handle.restart.remote()

    def actors(self) -> list[RoleHandle]:
        """Those with the lowest numbers first."""
        actors = [one for name, one in self._handles.items() if name.startswith("actor-")]
        return sorted(actors, key=lambda one: int(one.name.removeprefix("actor-")))

    def restarts(self) -> dict[str, int]:
        """How often each role was started again."""
        return {name: one.restarts for name, one in self._handles.items()}

    def waiting(self) -> list[str]:
        """Roles that run nowhere now."""
        return [name for name, one in self._handles.items() if not one.running]

    def finished(self) -> bool:
        """Whether the learner has ended cleanly, and its last checkpoint is on the head."""
        learner = self._handles.get("learner")
        return learner is not None and learner.report is not None and learner.report.status == 0

    # The end

    def tell_stop(self) -> None:
        """That the run ends: what ends now is not started again. A new launcher hears first who runs."""
        deadline = time.monotonic() + NOTICE_SECONDS
        while any(one.report is None for one in self._handles.values()) and time.monotonic() < deadline:
            self._ask_all()
            time.sleep(HEAR_SECONDS)
        told = [one.handle.stopping.remote(True) for one in self._handles.values() if one.running]
        _wait(told, NOTICE_SECONDS)

    def all_ended(self) -> bool:
        """Whether no role runs, and what each left is put away, as last heard; they are asked again."""
        self._ask_all()
        return not any(one.awaited for one in self._handles.values())

    def _ask_all(self) -> None:
        for one in self._handles.values():
            with suppress(RoleDied):
                one.ask(self._folder.logs)

    def close(self, over: bool, saving: float) -> None:
        """End all; of a run that is ``over`` nothing is left on the nodes. ``saving``: seconds of a checkpoint."""
        _wait([one.handle.close.remote() for one in self._handles.values() if one.awaited], CLOSE_SECONDS + saving)
        if over and not self._kept_elsewhere():
            _wait(self._cleared(), CLEAR_SECONDS)
        for one in self._handles.values():
            ray.kill(one.handle, no_restart=True)
        for group in self._groups.values():
            remove_placement_group(group)

    def _cleared(self) -> list[Any]:
        """Of every node, also of those that roles have left."""
        nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"]]
        there = (NodeAffinitySchedulingStrategy(node, soft=False) for node in nodes)
        clear = ray.remote(num_cpus=0)(clear_scratch)
        return [clear.options(scheduling_strategy=node).remote(self._folder.name) for node in there]

    def _kept_elsewhere(self) -> bool:
        """Whether something of the run is on a node alone, where its hosts share a folder."""
        troubled = [one for one in self._handles.values() if one.trouble]
        for one in troubled:
            log.warning("what %s left stays on %s: %s", one.name, one.node, one.trouble)
        return bool(troubled)


def _wait(replies: list[Any], seconds: float) -> None:
    if replies:
        ray.wait(replies, num_returns=len(replies), timeout=seconds)
