"""The ceiling of the learner's benchmark, and what the memory's takes for whom, on the code as it is."""

import psutil
import pytest

from benchmarks import learner, memory
from rmc.common.env.config import EnvConfig
from rmc.deploy.run.presets import robust
from rmc.learner.config import MODEL_PROCESS


def test_a_bare_pass_trains_steps() -> None:
    assert learner._bare(robust(EnvConfig("Pendulum-v1")), 2, "fp32", 0.01)() > 0


@pytest.mark.parametrize(
    ("words", "role"),
    [
        (["/usr/bin/valkey-server unixsocket:/tmp/x.sock"], "redis"),
        ([f"{MODEL_PROCESS}   "], MODEL_PROCESS),
        (["python", "-P", "-m", "rmc.cli.main", "role", "actor", "--run", "x", "--index", "0"], "actor"),
    ],
)
def test_memory_is_that_of_the_right_role(words: list[str], role: str, monkeypatch: pytest.MonkeyPatch) -> None:
    own = psutil.Process()
    monkeypatch.setattr(psutil.Process, "cmdline", lambda _: words)
    monkeypatch.setattr(psutil.Process, "children", lambda *_, **__: [psutil.Process(own.ppid())])
    readings: dict[str, list[float]] = {name: [] for name in memory.ROLES}
    memory._look(own, readings)
    assert {name: len(found) for name, found in readings.items() if found} == {"launcher": 1, role: 1}
