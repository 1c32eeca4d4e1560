"""Memory that both ends see, which neither can cut short, and in which a fault is noticed."""

import os

import numpy as np
import pytest

from rmc.common.errors import MessageError
from rmc.common.row_checksum import add_checksums
from rmc.common.shared_batches import TURNS, SharedBatches, reserve_memory, shared_bytes
from rmc.common.window import WindowSpec
from tests.raising import raising

SPEC = WindowSpec(obs_dim=3, action_dim=2, state=4, burn_in=2, train=4)
BATCH = 8
pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="Linux")


@pytest.fixture
def descriptor():
    memory = reserve_memory(shared_bytes(SPEC, BATCH))
    assert memory is not None
    yield memory
    os.close(memory)


def test_a_sandbox_that_refuses_such_memory_gets_none(monkeypatch):
    monkeypatch.setattr(os, "memfd_create", raising(PermissionError(1, os.strerror(1))))
    assert reserve_memory(4096) is None


def test_batches_take_turns_and_are_seen_by_the_other_side(descriptor):
    server, learner = SharedBatches(descriptor, SPEC, BATCH), SharedBatches(descriptor, SPEC, BATCH)
    replies = []
    for number in range(TURNS):
        server.rows[server.turn]["serial"] = number
        add_checksums(server.rows[server.turn])
        replies.append(server.put(np.full(BATCH, float(number))))
    for number, one in enumerate(replies):
        rows, values = learner.take(one)
        assert (rows["serial"] == number).all()
        assert (values == number).all()


@pytest.fixture
def sent(descriptor):
    """A server that has put one batch, its learner, and what it is told."""
    server, learner = SharedBatches(descriptor, SPEC, BATCH), SharedBatches(descriptor, SPEC, BATCH)
    add_checksums(server.rows[0])
    return server, learner, server.put(np.ones(BATCH))


def test_a_torn_batch_and_a_wrong_turn_are_refused(sent):
    server, learner, reply = sent
    server.rows[0]["reward"][3, 1] = 5.0
    with pytest.raises(MessageError, match="crc"):
        learner.take(reply)
    for turn in (TURNS, -1, "0", None):
        with pytest.raises(MessageError, match="turn"):
            learner.take({**reply, "turn": turn})


def test_another_whole_batch_in_that_turn_is_refused(sent):
    """With equal weights: whole rows have all one CRC."""
    server, learner, reply = sent
    server.rows[0]["serial"] = 7
    add_checksums(server.rows[0])
    with pytest.raises(MessageError, match="crc"):
        learner.take(reply)


def test_nobody_can_cut_it_short(descriptor):
    with pytest.raises(PermissionError):
        os.ftruncate(descriptor, 0)
