"""Which node a run's rings are looked for on. Ray's answers are made up: its nodes on one machine share an address."""

from pathlib import Path
from typing import Any

import pytest

from rmc.deploy.ray import ring_nodes
from rmc.deploy.ray.ring_nodes import RingLocations
from rmc.deploy.run.folder import RunFolder

ROLES = ["replay-0", "replay-1", "replay-2"]


class Group:
    """A placement group that is there."""

    def ready(self) -> None:
        """At once."""


@pytest.fixture(autouse=True)
def cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    alive = {"a": True, "b": True, "c": False}
    nodes = [{"NodeID": name, "Alive": up, "NodeManagerAddress": f"10.0.0.{name}"} for name, up in alive.items()]
    table: dict[str, Any] = {"bundles_to_node_id": {0: "a", 1: "d", 2: "b"}}
    monkeypatch.setattr(ring_nodes.ray, "nodes", lambda: nodes)
    monkeypatch.setattr(ring_nodes.ray, "wait", lambda *_, **__: None)
    monkeypatch.setattr(ring_nodes, "placement_group_table", lambda _: table)


def test_a_ring_is_where_it_was_noted_while_that_node_lives(tmp_path: Path) -> None:
    RingLocations(RunFolder(tmp_path)).note("replay", "10.0.0.b")
    again = RingLocations(RunFolder(tmp_path))
    assert (again.node("replay"), again.node("replay-1")) == ("b", None)
    again.note("replay", "10.0.0.c")
    assert again.node("replay") is None


@pytest.mark.parametrize("cut", [b"", b'{"replay": "10'])
def test_a_note_that_is_cut_short_is_none(tmp_path: Path, cut: bytes) -> None:
    (tmp_path / "rings-at").write_bytes(cut)
    noted = RingLocations(RunFolder(tmp_path))
    assert noted.node("replay") is None
    noted.note("replay", "10.0.0.b")
    assert RingLocations(RunFolder(tmp_path)).node("replay") == "b"


def test_shards_take_the_bundles_of_their_nodes_and_the_others_what_is_left(tmp_path: Path) -> None:
    noted = RingLocations(RunFolder(tmp_path))
    assert noted.bundles(Group(), ROLES) == {"replay-0": 0, "replay-1": 1, "replay-2": 2}
    noted.note("replay-0", "10.0.0.c")  # gone
    noted.note("replay-1", "10.0.0.a")
    noted.note("replay-2", "10.0.0.b")
    assert noted.bundles(Group(), ROLES) == {"replay-0": 1, "replay-1": 0, "replay-2": 2}
