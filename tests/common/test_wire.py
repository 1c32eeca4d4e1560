"""Messages: what goes in comes out, and whatever else comes in is refused with a countable reason."""

from contextlib import suppress

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmc.common import wire
from rmc.common.errors import MessageError
from tests.learner.rows import SPEC, random_rows
from tests.replay_server.support import lawful_rows


def decode(payload: bytes):
    return lawful_rows(payload, SPEC)


def test_windows_round_trip():
    rows = random_rows(7)
    assert (decode(wire.encode_windows(rows, SPEC)) == rows).all()


@pytest.mark.parametrize("windows", [1, 2, 300])  # bodies of another kind of msgpack's binaries
def test_bodies_of_any_size_come_back(windows):
    rows = random_rows(windows)
    assert np.array_equal(decode(wire.encode_windows(rows, SPEC)), rows)


def test_hello_carries_no_rows():
    assert len(decode(wire.encode_hello(SPEC))) == 0


def repacked(index: int, value: object) -> bytes:
    fields = msgpack.unpackb(wire.encode_windows(random_rows(2), SPEC))
    fields[index] = value
    return msgpack.packb(fields)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "msgpack"),
        (b"\xc1", "msgpack"),
        (msgpack.packb({"a": 1}), "msgpack"),
        (msgpack.packb([1, 2]), "structure"),
        (b"\x96" + b"\x00" * (2 << 20), "too-large"),
        (repacked(0, 99), "version"),
        (repacked(0, "1"), "structure"),
        (repacked(0, True), "structure"),
        (repacked(1, 7), "kind"),
        (repacked(2, "0" * 16), "fingerprint"),
        (repacked(3, 3), "length"),
        (repacked(3, -1), "length"),
        (repacked(4, 1), "crc"),
        (msgpack.packb([1, 1, msgpack.ExtType(4, b"x"), 0, 0, b""]), "msgpack"),
        (msgpack.packb([1, 1, [[[]]], 0, 0, b""]), "structure"),
        (msgpack.packb([1, 1, "x" * 100, 0, 0, b""]), "msgpack"),
        (repacked(5, "text" * 9), "msgpack"),
        (wire.encode_windows(random_rows(2), SPEC) + b"more", "msgpack"),
        (wire.encode_windows(random_rows(2), SPEC)[:-1], "msgpack"),
        (wire.encode_hello(SPEC)[:-1], "msgpack"),
        (wire.encode_hello(SPEC)[:-1] + b"\x01", "msgpack"),
        (wire.encode_hello(SPEC)[:-2], "msgpack"),
    ],
)
def test_refusals_name_their_reason(payload, reason):
    with pytest.raises(MessageError) as caught:
        decode(payload)
    assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("field", "value"),
    [("first", 1), ("last", 99), ("last", 0), ("new_steps", -1), ("new_steps", 99), ("new_observations", 50)]
    + [(name, np.nan) for name in ("observation", "action", "prev_action", "reward", "state", "initial_priority")]
    + [("initial_priority", -1.0)],
)
def test_unlawful_windows_are_refused(field, value):
    rows = random_rows(3)
    rows[field][1] = value
    with pytest.raises(MessageError, match="window"):
        decode(wire.encode_windows(rows, SPEC))


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_mutated_entries_never_raise_anything_else(data):
    payload = bytearray(wire.encode_windows(random_rows(2), SPEC))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    for candidate in (bytes(payload), bytes(payload[:cut])):
        with suppress(MessageError):
            assert (decode(candidate)["last"] <= SPEC.steps).all()


def test_frame_round_trip():
    body = (b"abc", memoryview(np.arange(3)).cast("B"))
    raw = wire.encode_frame(wire.Kind.BATCH, {"env_steps": 5}, body)
    header = wire.decode_header(raw[: wire.HEADER.size], max_body=100)
    assert (header.kind, header.body_length) == (wire.Kind.BATCH, 27)
    assert wire.decode_meta(raw[wire.HEADER.size :], b"".join(body), header) == {"env_steps": 5}
    with pytest.raises(MessageError, match="crc"):
        wire.decode_meta(raw[wire.HEADER.size :], b"x" * 27, header)


@pytest.mark.parametrize(
    ("start", "patch", "reason"),
    [
        (0, b"NOPE", "version"),
        (4, b"\x09", "version"),
        (5, b"\xff", "kind"),
        (16, b"\xff" * 8, "too-large"),
        (8, b"\xff" * 4, "too-large"),
    ],
)
def test_bad_headers_are_refused_before_anything_is_read(start, patch, reason):
    raw = bytearray(wire.encode_frame(wire.Kind.SAMPLE, {}))[: wire.HEADER.size]
    raw[start : start + len(patch)] = patch
    with pytest.raises(MessageError) as caught:
        wire.decode_header(bytes(raw), max_body=1000)
    assert caught.value.reason == reason
