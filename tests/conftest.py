"""What every folder shares: a real Redis, the check that a test leaves nothing behind, and who runs beside whom.

``make test`` has two workers. One begins with the tests that only compute, at a low priority; all others are dealt out
module by module, those with trainings of their own first.
"""

import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import hypothesis
import psutil
import pytest
from xdist.scheduler import LoadScopeScheduling

PATIENT = (  # tests that only compute
    "actors/", "learner/", "studies/", "analysis/test_baselines", "analysis/test_policy", "docs/test_documents",
    "analysis/test_video", "integration/test_learning", "integration/test_lockstep", "integration/test_variants",
)  # fmt: skip
LONG = "integration/", "sweep/", "docs/", "faults/", "cli/", "packaging/"  # with trainings of their own
NICENESS = 10
WORKER = "PYTEST_XDIST_WORKER" in os.environ
os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch starts its threads: small products only, few cores
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as rmc has it: threads that spin starve the other worker
TEMPORARY = tempfile.mkdtemp(prefix="rmct-")  # so that what other runs on this machine leave is not taken for ours
os.environ["TMPDIR"] = tempfile.tempdir = TEMPORARY
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # begun in the background: what is tested must hear a Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)

from rmc.common.env.process_state import ApartCall  # noqa: E402
from rmc.deploy.redis.server import RedisServer  # noqa: E402

hypothesis.settings.register_profile("unhurried", deadline=None)  # a core is shared
hypothesis.settings.load_profile("unhurried")


@pytest.fixture(scope="session")
def redis_url() -> Iterator[str]:
    """A real server on a private unix socket. Name your run uniquely: it is shared by the whole session."""
    folder = Path(tempfile.mkdtemp(prefix="rmc-test-"))  # short: a socket path may have 107 bytes
    try:
        with RedisServer(folder) as server:
            yield server.url()
    finally:
        shutil.rmtree(folder)


class ByModule(LoadScopeScheduling):  # type: ignore[misc]
    """One scope for all patient tests, one for each other module."""

    def _split_scope(self, nodeid: str) -> str:
        return "patient" if is_patient(nodeid) else nodeid.partition("::")[0]


def is_patient(nodeid: str) -> bool:
    """Whether that test only computes."""
    return nodeid.removeprefix("tests/").startswith(PATIENT)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> ByModule:
    """Of ``--dist loadscope``."""
    return ByModule(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What only computes first, then what takes long: else one worker would wait for the other at the end."""
    items.sort(key=lambda item: (not is_patient(item.nodeid), not item.nodeid.removeprefix("tests/").startswith(LONG)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """A patient test steps back, where another worker may watch processes by the clock."""
    usual = os.getpriority(os.PRIO_PROCESS, 0)
    if WORKER and is_patient(item.nodeid):
        os.setpriority(os.PRIO_PROCESS, 0, max(usual, NICENESS))
    try:
        yield
    finally:
        with suppress(PermissionError):  # only root may take it back
            os.setpriority(os.PRIO_PROCESS, 0, usual)


def pytest_unconfigure() -> None:
    """The session's temporary folder goes with it."""
    shutil.rmtree(TEMPORARY, ignore_errors=True)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """PyTorch computes in one thread, so that the bits are the same everywhere."""
    import torch  # slow, and most tests need none

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder that goes with the test; pytest's own are too long for a socket's path, of 107 bytes at most."""
    with tempfile.TemporaryDirectory(prefix="rmc-") as folder:
        yield Path(folder)


@pytest.fixture
def run_name(request: pytest.FixtureRequest) -> str:
    """A run name that no other test has."""
    return f"{request.node.name}-{os.urandom(4).hex()}"


def _left_over() -> set[str]:
    children = {f"process {child.pid} {' '.join(child.cmdline()[:6])}" for child in _running_children()}
    temporary = {str(path) for path in Path(tempfile.gettempdir()).glob("rmc-sockets-*")}
    return children | temporary


def _torch_threads() -> float:
    torch = sys.modules.get("torch")
    return torch.get_num_threads() if torch else float("inf")


def _running_children() -> list[psutil.Process]:
    results = []
    for child in psutil.Process().children(recursive=True):
        try:
            if child.status() != psutil.STATUS_ZOMBIE and child.cmdline():
                results.append(child)
        except psutil.NoSuchProcess:
            continue
    return results


@pytest.fixture(autouse=True)
def no_environment_has_changed_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that changed it in an earlier test is forgotten."""
    monkeypatch.setattr(ApartCall, "env_states", {})
    monkeypatch.setattr(ApartCall, "changed", {})
    monkeypatch.setattr(ApartCall, "variables", {})


@pytest.fixture(autouse=True)
def leaves_nothing_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fails a test after which a process or a run's temporary folder is left, or torch with more threads."""
    if "redis_url" in request.fixturenames:
        request.getfixturevalue("redis_url")  # the session's server starts before the first look
    before, threads = _left_over(), _torch_threads()
    yield
    left = _left_over() - before
    assert not left, f"left behind: {sorted(left)}"
    assert _torch_threads() <= threads, "torch is left with more threads; the tests after this one would have them"
