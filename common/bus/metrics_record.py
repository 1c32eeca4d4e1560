"""A metrics record as bytes: what a role says of itself now and then. Read without trust in who wrote it.

Flat: names to numbers; what a role waits for (``…waiting_for``), why it cannot save (``checkpoint_error``) and who is
``not_running`` is text, and one metric is a list of numbers.
"""

import math
from collections.abc import Mapping
from typing import Any, TypeGuard

import msgpack

from rmc.common.errors import MessageError

MAX_BYTES, MAX_FIELDS, MAX_TEXT, MAX_LIST = 1 << 16, 512, 200, 4096
TEXT, LIST = (
    ("waiting_for", "checkpoint_error", "not_running"),
    "observation_unexplained",
)  # how names of texts end, and the list's
LARGEST = 2.0**63  # of a number; metrics are far below


def encode_record(record: Mapping[str, Any]) -> bytes:
    packed: bytes = msgpack.packb(dict(record), use_bin_type=True)
    return packed


def decode_record(packed: bytes) -> dict[str, Any]:
    """The record again. Raises MessageError with a countable reason; never anything else, whatever the bytes."""
    if len(packed) > MAX_BYTES:
        raise MessageError("too-large", f"a record of {len(packed)} bytes, at most {MAX_BYTES}")
    try:
        record = msgpack.unpackb(
            packed, raw=False, strict_map_key=True, max_map_len=MAX_FIELDS, max_array_len=MAX_LIST, max_ext_len=0,
            max_bin_len=0, max_str_len=MAX_TEXT,
        )  # fmt: skip
    except Exception as error:  # msgpack raises several unrelated classes on hostile bytes
        raise MessageError("msgpack", type(error).__name__) from None
    if not isinstance(record, dict):
        raise MessageError("structure", "a record is a map")
    for name, value in record.items():
        if not is_metric(name, value):
            raise MessageError("structure", f"{name!r:.80} is no metric")
    return record


def is_finite(value: Any) -> TypeGuard[float]:
    """Whether a value out of a record, which need not be there, is a number that can be compared and counted with."""
    return _is_number(value) and math.isfinite(value)


def is_complete(evaluation: Mapping[str, Any]) -> bool:
    """Whether all its episodes were played to their ends.

    Else it is compared with no other: of a task that punishes each step, one that was cut short would always be best.
    """
    return not (evaluation.get("eval_cut") or evaluation.get("eval_broken_episodes"))


def is_metric(name: str, value: Any) -> bool:
    """Whether a record may hold that: all who show one count with it."""
    if not is_plain(name):
        return False
    if name.endswith(TEXT):
        return is_plain(value)
    return all(map(_is_number, value)) if name == LIST and isinstance(value, list) else _is_number(value)


def is_plain(text: Any) -> TypeGuard[str]:
    """Whether it can be printed as it is: no control characters, no markup."""
    return isinstance(text, str) and text.isprintable() and "[" not in text


def _is_number(value: Any) -> bool:
    """NaN and infinity are numbers here: a loss may be one."""
    return type(value) is float or (type(value) is int and abs(value) < LARGEST)
