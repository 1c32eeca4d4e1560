"""Which actors end for a learner that lost its node."""

import pytest

from rmc.deploy.ray.placement import actors_in_the_way
from rmc.deploy.ray.role_actor import RoleReport
from rmc.deploy.ray.role_handle import RoleHandle

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


def test_none_end_where_all_are_too_few() -> None:
    assert actors_in_the_way({"CPU": 3.0}, NODE, {"CPU": 1.0}, [actor(0), actor(1, "10.0.0.3")]) is None
    assert actors_in_the_way({"CPU": 1.0, "GPU": 1.0}, NODE, {"CPU": 0.0}, [actor(0)]) is None
