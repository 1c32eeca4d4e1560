"""What does not fit this machine is refused in one line, which says what does."""

import dataclasses
import os
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
import torch

from rmc.common.agent_config import AgentConfig
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError
from rmc.deploy.run import host, preflight
from rmc.deploy.run.config import RunConfig, WindowConfig
from rmc.deploy.run.host import cores, this_machine
from rmc.deploy.run.launch_options import LaunchOptions
from rmc.deploy.run.preflight import (
    DISK_RESERVE,
    check_batch_fits,
    check_device,
    check_learner,
    check_machine,
    check_ring_fits,
    ring_bytes,
)
from rmc.deploy.run.presets import robust
from rmc.sweep.room import runs_that_fit


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> int:
    """Bytes of a machine that has little of it."""
    size = 200_000_000
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(total=size, available=size))
    return size


def run(trained_steps: int, batch_size: int) -> RunConfig:
    config = robust(EnvConfig("HalfCheetah-v5"))
    learner = dataclasses.replace(config.learner, batch_size=batch_size)
    replay = dataclasses.replace(config.replay, capacity=100)
    return dataclasses.replace(config, window=WindowConfig(10, trained_steps), learner=learner, replay=replay)


def test_a_batch_of_long_windows_that_no_memory_holds_is_refused_with_the_largest_that_it_may(memory: int) -> None:
    check_batch_fits(run(990, 8))
    with pytest.raises(
        ConfigError, match=r"^--batch-size=64: .* of windows of 1000 steps takes .* of 200.0 MB"
    ) as error:
        check_batch_fits(run(990, 64))
    most = int(str(error.value).rpartition(" ")[2])
    check_batch_fits(run(990, most))
    with pytest.raises(ConfigError, match=f"take at most {most}$"):
        check_batch_fits(run(990, most + 1))
    with pytest.raises(ConfigError, match="take fewer steps a window"):
        check_batch_fits(dataclasses.replace(run(9_990, 1), agent=AgentConfig(hidden=4_096)))


@pytest.mark.parametrize(("agent", "named"), [({"hidden": 65_536}, "--hidden"), ({"heads": (400_000, 9)}, "--heads")])
def test_networks_that_no_memory_holds_are_refused(agent: dict[str, Any], named: str, memory: int) -> None:
    config = run(15, 8)
    check_learner(config, "cpu")
    config = dataclasses.replace(config, agent=dataclasses.replace(config.agent, **agent))
    with pytest.raises(ConfigError, match=f"^{named}=.* of 200.0 MB free memory in training; take fewer units$"):
        check_learner(config, "cpu")


@pytest.mark.parametrize(
    ("agent", "named"), [({"hidden": 9_500}, "--hidden"), ({"heads": (16_400, 16_400)}, "--heads")]
)
def test_a_policy_that_is_too_large_to_be_published_is_refused(
    agent: dict[str, Any], named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preflight, "free_memory", lambda: 1 << 40)
    config = run(15, 8)
    with pytest.raises(ConfigError, match=f"^{named}=.* of 1.1 GB that a policy may have; take fewer units$"):
        check_learner(dataclasses.replace(config, agent=dataclasses.replace(config.agent, **agent)), "cpu")


def test_a_run_that_goes_on_is_offered_no_capacity_that_it_would_refuse(memory: int, tmp_path: Path) -> None:
    config = robust(EnvConfig("HalfCheetah-v5"))
    (tmp_path / "config.json").write_text("{}")
    for options in (LaunchOptions(tmp_path), LaunchOptions(None)):
        with pytest.raises(ConfigError, match=r"^--capacity=70000: takes .* of 200.0 MB memory; ") as error:
            check_ring_fits(config, options)
        assert ("take at most" in str(error.value)) == (options.run_dir is None)


def test_a_containers_memory_is_what_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit = tmp_path / "memory.max"
    use = tmp_path / "memory.current", tmp_path / "memory.stat"
    monkeypatch.setattr(host, "CONTAINER_LIMITS", (limit, tmp_path / "none"))
    monkeypatch.setattr(host, "CONTAINER_USE", [(tmp_path / "none", use[1], ""), (*use, "inactive_file")])
    for text in (None, "max\n", str(1 << 62)):
        if text is not None:
            limit.write_text(text)
        check_batch_fits(run(990, 8))
    limit.write_text("1000000\n")
    with pytest.raises(ConfigError, match=r"^--batch-size=8: .* of 1.0 MB free memory; take "):
        check_batch_fits(run(990, 8))
    config = run(15, 8)
    large = dataclasses.replace(config, replay=dataclasses.replace(config.replay, capacity=100_000))
    with pytest.raises(ConfigError, match=r"^--capacity=100000: takes .* of 1.0 MB memory; take at most \d+$"):
        check_ring_fits(large, LaunchOptions(tmp_path))
    assert this_machine(tmp_path).free_memory_bytes == 1_000_000
    use[0].write_text("700000\n")
    use[1].write_text("anon 500000\ninactive_file 200000\n")
    assert this_machine(tmp_path).free_memory_bytes == 500_000
    figures = host.HostFigures(tmp_path).take()
    assert (figures["host_available_bytes"], figures["host_memory_bytes"]) == (500_000, 1_000_000)
    use[0].write_text("9000000\n")
    assert this_machine(tmp_path).free_memory_bytes == 0
    use[0].unlink()
    assert runs_that_fit(1, 1_000_000) == 1


@pytest.mark.parametrize(
    ("texts", "most"),
    [
        (("max 100000\n",), None), (("100000 100000\n",), 1), (("150000 100000\n",), 2), (("10000 100000\n",), 1),
        (("-1\n", "100000\n"), None), (("100000\n", "100000\n"), 1), ((), None),
    ],
)  # fmt: skip
def test_so_is_its_share_of_the_cores(
    texts: tuple[str, ...], most: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / f"{number}" for number in range(max(1, len(texts)))]
    for file, text in zip(files, texts, strict=False):
        file.write_text(text)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    monkeypatch.setattr(host, "CPU_LIMITS", ((tmp_path / "none",), tuple(files)))
    assert cores() == (most or 64)


def test_a_gpu_that_is_not_there_is_refused_with_those_that_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for device in ("cpu", "cuda", "cuda:0", "cuda:1"):
        check_device(device)
    with pytest.raises(ConfigError, match=r"^--device='cuda:2': PyTorch sees 2; take cuda:0 to cuda:1$"):
        check_device("cuda:2")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"^--device='cuda:0': PyTorch sees no CUDA device; use --device cpu$"):
        check_device("cuda:0")


def test_a_run_is_refused_so_before_it_starts_but_on_a_gpu(memory: int, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(preflight, "check_device", lambda _: None)
    options = LaunchOptions(tmp_path / "run", "fail")
    with pytest.raises(ConfigError, match="--batch-size=64"):
        check_machine(run(990, 64), options)
    check_machine(run(990, 64), dataclasses.replace(options, device="cuda"))
    check_machine(run(15, 64), options)


@pytest.mark.parametrize("shards", [1, 2])
def test_a_ring_that_the_disk_does_not_hold_is_refused_with_the_largest_that_it_does(
    shards: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, options = DISK_RESERVE + 1_000_000, LaunchOptions(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))

    def of(capacity: int) -> RunConfig:
        config = run(15, 8)
        return dataclasses.replace(
            config, replay=dataclasses.replace(config.replay, capacity=capacity, replay_shards=shards)
        )

    with pytest.raises(ConfigError, match=r"^--capacity=100000: takes 37\d\.\d MB of disk") as error:
        check_ring_fits(of(100_000), options)
    most = int(re.findall(r"\d+", str(error.value))[-1])
    check_ring_fits(of(most - most % shards), options)
    assert ring_bytes(of(most + shards)) > 1_000_000
    for shard in of(100_000).shards():  # a run that goes on has its rings already
        (tmp_path / shard.role).mkdir()
        with (tmp_path / shard.role / "ring").open("wb") as ring:
            ring.truncate(ring_bytes(of(100_000)) // shards)
    check_ring_fits(of(100_000), options)
    with pytest.raises(ConfigError, match="--capacity=100000"):  # one beside it has none
        check_ring_fits(of(100_000), dataclasses.replace(options, if_exists="new"))


def test_a_ring_on_another_machine_is_not_judged_by_this_ones_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    options = LaunchOptions(tmp_path / "run", "fail")
    with pytest.raises(
        ConfigError, match=r"^--capacity=100: takes .* beside 268.4 MB for .*, 0 bytes are free; make room$"
    ):
        check_machine(run(15, 8), options)
    check_machine(run(15, 8), dataclasses.replace(options, launcher="ray"))
