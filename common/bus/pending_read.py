"""An XREAD whose answer is waited for elsewhere: sent ahead, it costs nothing until entries come."""

import time
from collections.abc import Mapping
from typing import Any

import redis

BLOCK_MS = 1000  # after which Redis answers even if nothing came
LATE_SECONDS = 10.0  # beyond that: the connection is dead


class PendingRead:
    """One at a time, on a connection of its own. Methods raise what redis-py raises."""

    def __init__(self, pool: Any) -> None:  # Any: its annotations leave the connection open
        self._pool = pool
        self._connection: Any = None  # made by the first question
        self._late = 0.0
        self.asked: Mapping[Any, Any] | None = None  # cursors by actor, while an answer is awaited

    def send(self, asked: Mapping[Any, Any], streams: Mapping[str, str], count: int) -> None:
        """Ask for up to ``count`` entries of each stream past the ids."""
        self._connection = self._connection or self._pool.get_connection()
        self._connection.send_command(
            "XREAD", "COUNT", count, "BLOCK", BLOCK_MS, "STREAMS", *streams, *streams.values()
        )
        self.asked, self._late = asked, time.monotonic() + BLOCK_MS / 1000 + LATE_SECONDS

    def ready(self) -> bool:
        """Whether the answer has begun to come, or never will."""
        if self._connection.can_read(0):
            return True
        if time.monotonic() > self._late:
            raise redis.exceptions.TimeoutError("no answer to XREAD")
        return False

    def take(self) -> list[tuple[bytes, list[tuple[bytes, dict[bytes, bytes]]]]]:
        """Streams with their entries, as redis-py would give them."""
        self.asked = None
        reply = self._connection.read_response() or {}
        streams = reply.items() if isinstance(reply, dict) else reply  # RESP3 or RESP2
        return [(name, [(raw_id, _fields(raw)) for raw_id, raw in entries]) for name, entries in streams]

    def drop(self) -> None:
        """Forget the question, and the connection on which its answer may still come."""
        self.asked = None
        if self._connection is not None:
            self._connection.disconnect()


def _fields(raw: list[bytes]) -> dict[bytes, bytes]:
    return dict(zip(raw[::2], raw[1::2], strict=True))
