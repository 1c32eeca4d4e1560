"""Several replay servers are one: the same distribution, the same weights, the same ratio, and each step once."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.replay import EMPTY_SAMPLE, Sample, SampleStatus
from rmc.common.shard import Shard
from rmc.common.window import WindowSpec
from rmc.deploy.run.folder import RunFolder
from rmc.learner.batch import importance_weights
from rmc.learner.replay.sharded import ShardedReplay
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.server import ReplayServer
from tests.integration.running import Training
from tests.replay_server.support import SPEC, Sender

ACTORS, BATCH = 4, 32
WINDOWS = [40, 10, 25, 5]  # of each actor: shards are not equal
FREE = ReplayConfig(capacity=400, replay_ratio=1e9, warmup_steps=0)
FREE_AND_SMALL = ReplayConfig(capacity=40, replay_ratio=1e9, warmup_steps=0)


class Whole:
    """Replay servers in this thread, and the learner's view of them."""

    def __init__(
        self, folder: Path, count: int, config: ReplayConfig = FREE, total: int = 10**9, spec: WindowSpec = SPEC
    ) -> None:
        self.bus = MemoryBus()
        self.servers = [
            ReplayServer(spec, config, folder / str(k), 3, total, ACTORS, 64, self.bus, Shard(k, count))
            for k in range(count)
        ]
        self.replay = ShardedReplay(self.servers, spec, BATCH, seed=1)
        self.senders = [Sender(self.bus, actor, spec) for actor in range(ACTORS)]
        self.take_in()

    def take_in(self) -> None:
        for server in self.servers:
            while server.step():
                pass

    def send(self, windows: list[int]) -> None:
        for sender, count in zip(self.senders, windows, strict=True):
            if count:
                sender.send(count)
        self.take_in()


@pytest.fixture
def wholes(tmp_path: Path) -> Iterator[list[Whole]]:
    systems = [Whole(tmp_path / f"of-{count}", count) for count in (1, 2, 4)]
    yield systems
    for whole in systems:
        for server in whole.servers:
            server.close()


def name(row: np.void) -> tuple[int, int]:
    return int(row["actor"]), int(row["reward"][0])


def priority(actor: int, mark: int) -> float:
    """Very unequal, and in one actor larger than in the others."""
    return (1 + mark % 7) ** 2 * (10.0 if actor == 3 else 1.0)


def give_priorities(whole: Whole) -> None:
    """Draw until every window was seen and has got its own priority."""
    left = {(actor, mark) for actor, count in enumerate(WINDOWS) for mark in range(count)}
    while left:
        sample = whole.replay.sample(BATCH)
        assert sample.rows is not None
        priorities = np.array([priority(*name(row)) for row in sample.rows], np.float32)
        whole.replay.update_priorities(sample.rows["serial"].copy(), priorities)
        left -= {name(row) for row in sample.rows}


def test_any_number_of_shards_samples_with_the_same_distribution(wholes: list[Whole]) -> None:
    names = [(actor, mark) for actor, count in enumerate(WINDOWS) for mark in range(count)]
    expected = np.array([priority(*window) for window in names]) ** FREE.priority_exponent
    draws = 600
    for whole in wholes:
        whole.send(WINDOWS)
        give_priorities(whole)
        for _ in range(20):  # what was drawn by the old priorities is still in stock
            whole.replay.sample(BATCH)
        counts = dict.fromkeys(names, 0)
        for _ in range(draws):
            sample = whole.replay.sample(BATCH)
            assert sample.rows is not None
            assert sample.weights is not None
            for row in sample.rows:
                counts[name(row)] += 1
            weights = importance_weights(sample.weights, 0.4)
            truth = np.array([priority(*name(row)) for row in sample.rows]) ** (-0.4 * FREE.priority_exponent)
            np.testing.assert_allclose(weights, truth / truth.max(), rtol=1e-5)
            assert sample.total_weight == pytest.approx(expected.sum())
        drawn = np.array(list(counts.values()))
        assert drawn.sum() == draws * BATCH
        p_value = stats.chisquare(drawn, draws * BATCH * expected / expected.sum()).pvalue
        assert p_value > 1e-3, (len(whole.servers), p_value)


def test_statistics_and_counters_are_those_of_one_server(wholes: list[Whole]) -> None:
    for whole in wholes:
        whole.send(WINDOWS)
        assert whole.replay.sample(BATCH).env_steps == sum(WINDOWS) * SPEC.train
    one, two, four = (whole.replay.statistics() for whole in wholes)
    assert one.count == two.count == four.count == sum(WINDOWS) * SPEC.train
    for other in (two, four):
        np.testing.assert_allclose(other.total, one.total)
        np.testing.assert_allclose(other.total_square, one.total_square)


class Away:
    """A shard that hangs: whoever asks it waits until its time is out."""

    asked = 0

    def sample(self, *_: object) -> Sample:
        self.asked += 1
        return EMPTY_SAMPLE

    def statistics(self) -> None:
        self.asked += 1


def test_of_several_shards_that_hang_one_is_asked() -> None:
    shards = [Away() for _ in range(3)]
    replay = ShardedReplay(cast(Any, shards), SPEC, BATCH, seed=1)
    assert replay.sample(BATCH).status is SampleStatus.WAIT
    assert replay.statistics() is None
    assert [shard.asked for shard in shards] == [2, 0, 0]


def test_windows_by_number_with_what_critics_see_are_drawn_and_counted_alike(tmp_path: Path) -> None:
    spec = dataclasses.replace(SPEC, missing=SPEC.obs_dim, privileged=2)
    one, two = (Whole(tmp_path / f"of-{count}", count, spec=spec) for count in (1, 2))
    for whole in (one, two):
        whole.send(WINDOWS)
        rows = whole.replay.sample(BATCH).rows
        assert rows is not None
        assert (rows["missing"].shape, rows["privileged"].shape) == ((BATCH, 7, 3), (BATCH, 7, 2))
        assert whole.replay.statistics().count.tolist() == [sum(WINDOWS) * spec.train] * 5
    np.testing.assert_allclose(one.replay.statistics().total, two.replay.statistics().total)
    for server in (*one.servers, *two.servers):
        server.close()


def test_an_episode_is_found_in_its_shard(wholes: list[Whole]) -> None:
    whole = wholes[2]
    whole.send(WINDOWS)
    sample = whole.replay.sample(BATCH)
    assert sample.rows is not None
    for row in sample.rows:
        episode = whole.replay.episode(int(row["serial"]))
        assert episode is not None
        assert [name(window) for window in episode] == [name(row)]


@pytest.mark.parametrize("count", [1, 2, 4])
def test_priorities_find_their_windows_in_rings_that_wrap(count: int, tmp_path: Path) -> None:
    whole = Whole(tmp_path, count, FREE_AND_SMALL)
    for _ in range(7):
        whole.send([3, 3, 3, 3])
    for server in whole.servers:
        assert 0.9 <= server.stats()["ring_fill"] <= 1.0
    for _ in range(60):
        sample = whole.replay.sample(BATCH)
        assert sample.rows is not None
        priorities = np.array([priority(*name(row)) for row in sample.rows], np.float32)
        whole.replay.update_priorities(sample.rows["serial"].copy(), priorities)
    assert sample.rows is not None
    assert sample.weights is not None
    truth = np.array([priority(*name(row)) for row in sample.rows]) ** FREE_AND_SMALL.priority_exponent
    np.testing.assert_allclose(sample.weights, truth, rtol=1e-5)
    for server in whole.servers:
        server.close()


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_ratio_holds_over_the_whole(count: int, tmp_path: Path) -> None:
    """Actors that send what they are granted, a learner that draws what it may: the end is where one server's is."""
    ratio, total, warmup = 8.0, 2_000, 400
    config = ReplayConfig(capacity=4_000, replay_ratio=ratio, warmup_steps=warmup, priority_exponent=0.0)
    whole = Whole(tmp_path, count, config, total)
    batches, worst = 0, 0.0
    while (sample := whole.replay.sample(BATCH)).status is not SampleStatus.FINISHED:
        if sample.status is SampleStatus.BATCH:
            batches += 1
            worst = max(worst, batches * BATCH * SPEC.train - ratio * (sample.env_steps - warmup))
        else:
            whole.send([(sender.granted() - SPEC.train * sender.marks) // SPEC.train for sender in whole.senders])
    assert sample.env_steps == total
    assert sum(sender.marks for sender in whole.senders) == total // SPEC.train
    lead = BATCH * SPEC.train  # a batch is the limiter's tolerance, and its grain at the end
    assert worst <= lead + ratio * 64
    grain = lead if count == 1 else (1 + count) * lead  # a shard hears of what others drew with its next draw
    assert abs(batches * lead - ratio * (total - warmup)) <= grain
    for server in whole.servers:
        assert server.stats()["replay_ratio"] == pytest.approx(ratio, rel=0.02)
        server.close()


def test_a_shard_goes_on_after_a_restart(tmp_path: Path) -> None:
    config = ReplayConfig(capacity=400, replay_ratio=8.0, warmup_steps=0)
    whole = Whole(tmp_path, 2, config)
    whole.send([20, 20, 20, 20])
    for _ in range(4):
        assert whole.replay.sample(BATCH).status is SampleStatus.BATCH
    before = whole.servers[1].stats()
    whole.servers[1].close()
    again = ReplayServer(SPEC, config, tmp_path / "1", 3, 10**9, ACTORS, 64, whole.bus, Shard(1, 2))
    assert {key: value for key, value in again.stats().items() if not key.endswith("_s")} == {
        key: value for key, value in before.items() if not key.endswith("_s")
    }
    again.close()
    whole.servers[0].close()


def test_a_whole_run_with_two_shards(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    options = ["--actors", "4", "--replay-shards", "2", "--total-steps", "1500"]
    with Training(folder, *options) as training:
        assert training.finish(170) == 0, training.text() + training.logs()
    result = json.loads((folder / "result.json").read_text())
    # A grant is never taken back: while one actor still holds a larger one, what is left is shared anew among all.
    assert 1500 <= result["env_steps"] < 1575
    slack = 2 * 15 * 2 * 4  # two windows of each of two environments of four actors, which a learner may run ahead
    assert -1.0 <= result["replay_ratio"] - 32.0 <= 32.0 * slack / (1500 - 500) + 1.0
    assert result["restarts"] == 0
    assert (folder / "replay-0" / "ring").exists()
    assert (folder / "replay-1" / "ring").exists()
    assert {"replay-0", "replay-1"} <= {record["role"] for record in RunFolder(folder).records()}


def test_no_shard_draws_as_another_does(wholes: list[Whole]) -> None:
    whole = wholes[1]
    whole.send([20] * ACTORS)
    draws = [[server.sample(8).rows["serial"].tolist() for _ in range(5)] for server in whole.servers]  # type: ignore[index]
    assert not any(map(list.__eq__, *draws))
