"""Groups of roles that wait for a node: those of all runs of the cluster, for no run's actors come before any."""

import re
import time

from ray.util.placement_group import placement_group_table

PLACED = {"CREATED", "REMOVED"}
NAMES = re.compile(r".*:(learner|replay-\d+)")  # by ``actor_name``


class WaitingGroups:
    """For how long each has been seen without a node."""

    def __init__(self) -> None:
        self._since: dict[str, float] = {}

    def look(self) -> dict[str, float]:
        """The seconds until now, by the group's name."""
        now = time.monotonic()
        groups = placement_group_table().values()
        waiting = [one["name"] for one in groups if one["state"] not in PLACED and NAMES.fullmatch(one["name"])]
        self._since = {name: self._since.get(name, now) for name in waiting}
        return {name: now - since for name, since in self._since.items()}

    def count_anew(self, name: str) -> None:
        """From now on, because something was done for it."""
        self._since[name] = time.monotonic()
