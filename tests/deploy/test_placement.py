"""Which actors end for a learner that lost its node."""

import dataclasses
import re

import pytest

from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.ray import placement
from rmc.deploy.ray.placement import actors_in_the_way
from rmc.deploy.ray.role_actor import RoleReport
from rmc.deploy.ray.role_handle import RoleHandle
from rmc.deploy.run.presets import debug

NODE = {"NodeManagerAddress": "10.0.0.2"}


def actor(index: int, node: str = "10.0.0.2", pid: int | None = 1) -> RoleHandle:
    handle = RoleHandle(f"actor-{index}", None)
    handle.report = RoleReport("", node, pid, None, "", b"", 0, "")
    return handle


@pytest.mark.parametrize(
    ("free", "names"),
    [
        ({"CPU": 2.0}, []),  # Ray is about to place it
        ({"CPU": 1.5}, ["actor-2"]),
        ({"CPU": 1.0}, ["actor-2"]),
        ({}, ["actor-1", "actor-2"]),
    ],
)
def test_the_last_ones_end_and_no_more_than_must(free: dict[str, float], names: list[str]) -> None:
    there = [actor(index) for index in range(3)]
    going = actors_in_the_way({"CPU": 2.0}, NODE, free, [*there, actor(3, "10.0.0.3"), actor(4, pid=None)])
    assert going is not None
    assert [one.name for one in going] == names


@pytest.mark.parametrize(
    ("device", "resources", "says"),
    [
        ("cpu", {"CPU": 8.0}, "--threads=8: no node of the cluster has 9 CPU, which the learner and what is beside it"),
        ("cuda", {"CPU": 8.0}, "--device='cuda': no node of the cluster has 9 CPU, 1 GPU, which the learner"),
        ("cuda", {"CPU": 8.0, "GPU": 1.0}, "--threads=8: no node of the cluster has 9 CPU, 1 GPU, which the learner"),
    ],
)
def test_the_option_that_asks_for_too_much_is_named(
    device: str, resources: dict[str, float], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(placement.ray, "nodes", lambda: [{"Alive": True, "Resources": resources}])
    config = debug(EnvConfig("InvertedPendulum-v5"))
    config = dataclasses.replace(config, learner=dataclasses.replace(config.learner, threads=8))
    with pytest.raises(ConfigError, match=f"^{re.escape(says)}"):
        placement.check_room(config, device)


def test_none_end_where_all_are_too_few() -> None:
    assert actors_in_the_way({"CPU": 3.0}, NODE, {"CPU": 1.0}, [actor(0), actor(1, "10.0.0.3")]) is None
    assert actors_in_the_way({"CPU": 1.0, "GPU": 1.0}, NODE, {"CPU": 0.0}, [actor(0)]) is None
