"""Which node a run's rings are looked for on. Ray's answers are made up: its nodes on one machine share an address."""

from pathlib import Path

import pytest

from rmc.deploy.ray import ring_nodes
from rmc.deploy.ray.ring_nodes import RingLocations
from rmc.deploy.run.folder import RunFolder


@pytest.fixture(autouse=True)
def cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    alive = {"a": True, "b": True, "c": False}
    nodes = [{"NodeID": name, "Alive": up, "NodeManagerAddress": f"10.0.0.{name}"} for name, up in alive.items()]
    monkeypatch.setattr(ring_nodes.ray, "nodes", lambda: nodes)


def test_a_ring_is_where_it_was_noted_while_that_node_lives(tmp_path: Path) -> None:
    RingLocations(RunFolder(tmp_path)).note("replay", "10.0.0.b")
    again = RingLocations(RunFolder(tmp_path))
    assert (again.node("replay"), again.node("replay-1")) == ("b", None)
    again.note("replay", "10.0.0.c")
    assert again.node("replay") is None


@pytest.mark.parametrize("damaged", [b"", b'{"replay": "10', b"[1]", b"5"])
def test_a_note_that_is_damaged_is_none(tmp_path: Path, damaged: bytes) -> None:
    (tmp_path / "rings-at").write_bytes(damaged)
    noted = RingLocations(RunFolder(tmp_path))
    assert noted.node("replay") is None
    noted.note("replay", "10.0.0.b")
    assert RingLocations(RunFolder(tmp_path)).node("replay") == "b"
