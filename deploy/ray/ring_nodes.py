"""Where the rings of a run lie on a cluster, so that one that goes on finds them again."""

import json
from contextlib import suppress

import ray
from ray.util.placement_group import PlacementGroup, placement_group_table

from rmc.common.whole_file import write_whole
from rmc.deploy.run.folder import RunFolder

READY_SECONDS = 5.0


class RingLocations:
    """The address of every replay server's node, kept in the run's folder."""

    def __init__(self, folder: RunFolder) -> None:
        self._path = folder.path / "rings-at"
        self._at: dict[str, str] = {}
        with suppress(OSError, ValueError):  # cut short, or not there yet: Ray places them anywhere
            self._at.update(json.loads(self._path.read_bytes()))

    def note(self, role: str, address: str) -> None:
        """A replay server runs there now."""
        if self._at.get(role) != address:
            with suppress(OSError):  # the disk is full: until it is not, a later launcher would not find the ring
                write_whole(self._path, json.dumps({**self._at, role: address}).encode())
                self._at[role] = address

    def node(self, role: str) -> str | None:
        """Ray's id of the node that holds a ring, while that node is alive."""
        address = self._at.get(role)
        nodes = [node["NodeID"] for node in ray.nodes() if node["Alive"] and node["NodeManagerAddress"] == address]
        return nodes[0] if address and nodes else None

    def bundles(self, group: PlacementGroup, roles: list[str]) -> dict[str, int]:
        """A bundle of the group for each role: one on its ring's node where there is one, else any."""
        ray.wait([group.ready()], timeout=READY_SECONDS)
        nodes = dict(placement_group_table(group)["bundles_to_node_id"])
        homes = {role: node for role in roles if (node := self.node(role)) is not None}
        free = list(range(len(roles)))
        chosen = {}
        for role in sorted(roles, key=lambda role: role not in homes):  # who has a home chooses first
            there = [index for index in free if role in homes and nodes.get(index) == homes[role]]
            chosen[role] = (there or free)[0]
            free.remove(chosen[role])
        return chosen
