"""Records of metrics: read back as written, and nothing else is taken for one."""

import math

import msgpack
import pytest

from rmc.common.bus.metrics_record import MAX_BYTES, decode_record, encode_record
from rmc.common.errors import MessageError

RECORD = {"time": 1.5, "updates": 7, "q_loss": 0.25, "waiting_for": "credit", "observation_unexplained": [0.5, 1]}


def test_round_trip():
    assert decode_record(encode_record(RECORD)) == RECORD
    assert math.isnan(decode_record(encode_record({"q_loss": math.nan}))["q_loss"])


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ([1], "structure"),
        ({1: 2}, "msgpack"),
        ({"updates": "7"}, "structure"),
        ({"updates": [7]}, "structure"),
        ({"updates": {"a": 1}}, "structure"),
        ({"updates": None}, "structure"),
        ({"updates": True}, "structure"),
        ({"updates": 2**63}, "structure"),
        ({"updates": b"7"}, "msgpack"),
        ({"waiting_for": 7}, "structure"),
        ({"waiting_for": "\x1b[2J"}, "structure"),
        ({"waiting_for": "[red]credit"}, "structure"),
        ({"waiting_for": "x" * 300}, "msgpack"),
        ({"a\nb": 1}, "structure"),
        ({"observation_unexplained": ["x"]}, "structure"),
        ({f"name{i}": i for i in range(1000)}, "msgpack"),
        ({"updates": msgpack.ExtType(1, b"x")}, "msgpack"),
        ({f"name{i}": 0.0 for i in range(MAX_BYTES // 10)}, "too-large"),
    ],
)
def test_what_is_none_is_refused(value, reason):
    with pytest.raises(MessageError) as error:
        decode_record(msgpack.packb(value))
    assert error.value.reason == reason
