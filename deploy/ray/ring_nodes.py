"""Where the rings of a run lie on a cluster, so that one that goes on finds them again."""

import json
from contextlib import suppress

import ray

from rmc.common.errors import ConfigError
from rmc.common.whole_file import write_whole
from rmc.deploy.run.folder import RunFolder, read_object


class RingLocations:
    """The address of every replay server's node, kept in the run's folder."""

    def __init__(self, folder: RunFolder) -> None:
        self._path = folder.path / "rings-at"
        self._at: dict[str, str] = {}
        with suppress(OSError, ConfigError):  # damaged, or not there yet: Ray places them anywhere
            self._at.update(read_object(self._path))

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
