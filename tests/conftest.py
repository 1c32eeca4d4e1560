"""Fixtures that every folder shares: a real Redis, and the check that a test leaves nothing behind."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch starts its threads: small products only, few cores
TEMPORARY = tempfile.mkdtemp(prefix="rmct-")  # so that what other runs on this machine leave is not taken for ours
os.environ["TMPDIR"] = tempfile.tempdir = TEMPORARY

from deploy.redis_server import RedisServer  # noqa: E402


@pytest.fixture(scope="session")
def redis_url() -> Iterator[str]:
    """A real server on a private unix socket. Name your run uniquely: it is shared by the whole session."""
    folder = Path(tempfile.mkdtemp(prefix="rmc-test-"))  # short: a socket path may have 107 bytes
    try:
        with RedisServer(folder) as server:
            yield server.url()
    finally:
        shutil.rmtree(folder)


def pytest_unconfigure() -> None:
    """The session's temporary folder goes with it."""
    shutil.rmtree(TEMPORARY, ignore_errors=True)


@pytest.fixture
def run_name(request: pytest.FixtureRequest) -> str:
    """A run name that no other test has."""
    return f"{request.node.name}-{os.urandom(4).hex()}"


def _left_over() -> set[str]:
    children = {f"process {child.pid} {' '.join(child.cmdline()[:6])}" for child in _running_children()}
    temporary = {str(path) for path in Path(tempfile.gettempdir()).glob("rmc-run-*")}
    shared = {str(path) for path in Path("/dev/shm").glob("*")} if Path("/dev/shm").is_dir() else set()
    return children | temporary | shared


def _running_children() -> list[psutil.Process]:
    found = []
    for child in psutil.Process().children(recursive=True):
        try:
            if child.status() != psutil.STATUS_ZOMBIE and child.cmdline():
                found.append(child)
        except psutil.NoSuchProcess:
            continue
    return found


@pytest.fixture(autouse=True)
def leaves_nothing_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fails a test after which a process, a run's temporary folder or shared memory is left."""
    if "redis_url" in request.fixturenames:
        request.getfixturevalue("redis_url")  # the session's server starts before the first look
    before = _left_over()
    yield
    left = _left_over() - before
    assert not left, f"left behind: {sorted(left)}"
