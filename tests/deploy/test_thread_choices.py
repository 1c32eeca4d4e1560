"""Which numbers of threads a learner tries on so many cores."""

from dataclasses import replace

import pytest

from rmc.common.env.config import EnvConfig
from rmc.deploy.run.preflight import learner_threads, thread_choices, two_processes
from rmc.deploy.run.presets import preset_config


@pytest.mark.parametrize(
    ("scheme", "threads", "cores", "device", "choices", "both", "least"),
    [
        (3, 0, 1, "cpu", (1,), False, 1),
        (3, 0, 2, "cpu", (1,), True, 2),
        (3, 0, 16, "cpu", (1, 2, 4, 8), True, 2),
        (1, 0, 2, "cpu", (1, 2), False, 1),
        (1, 0, 6, "cpu", (1, 2, 4), False, 1),
        (3, 1, 8, "cpu", (1,), False, 1),
        (3, 6, 8, "cpu", (3,), True, 6),
        (1, 6, 8, "cpu", (6,), False, 6),
        (3, 0, 8, "cuda", (1,), False, 1),
    ],
)
def test_choices(scheme, threads, cores, device, choices, both, least) -> None:
    robust = preset_config("robust", EnvConfig("HalfCheetah-v5"))
    update, learner = replace(robust.update, scheme=scheme), replace(robust.learner, threads=threads)
    config = replace(robust, update=update, learner=learner)
    assert thread_choices(config, cores, device) == choices
    assert two_processes(config, cores, device) is both
    if device == "cpu":
        assert learner_threads(config, cores) == least
