"""The bus: one small interface between the roles, over Redis or inside one process.

Every Redis key, R = ``rmc:{run}``:

| key                     | type   | writer   | holds                                                    |
|-------------------------|--------|----------|----------------------------------------------------------|
| R:config                | string | launcher | the run's config, JSON                                   |
| R:epoch:ROLE            | string | ROLE     | INCR at a role's start; the larger epoch wins            |
| R:actors                | set    | actors   | ids of the actors that said hello                        |
| R:windows:ACTOR         | stream | actor    | entries ``epoch-seq``, field ``p`` = a wire entry        |
| R:acks                  | hash   | replay   | ACTOR -> ``epoch seq granted_steps final``               |
| R:progress              | hash   | replay   | ROLE of a shard -> its newest commit's counters          |
| R:replay                | hash   | replay   | ROLE of a shard -> where it listens                      |
| R:weights               | string | learner  | ``epoch update pieces crc32`` of the newest weights      |
| R:weights:EPOCH:UPDATE:I| string | learner  | piece I (256 KiB) of a policy, safetensors               |
| R:evaluate              | string | learner  | ``epoch update pieces crc32`` the evaluator should play  |
| R:evaluate:EPOCH:UPDATE:I| string | learner | piece I of that policy                                   |
| R:metrics:ROLE          | stream | ROLE     | records, msgpack, about the last 300                     |
| R:stop                  | string | launcher | why the run should end                                   |
| R:dead                  | stream | replay   | refused entries: actor, id, reason, first 1 KiB; 1 000   |
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol

MAX_EPOCH_GAP = 1 << 16  # epochs that a role can take at most beyond the last one that is known of it
METRICS_KEPT = 300  # records of a role, at least: five minutes


class EntryId(NamedTuple):
    """A stream entry's explicit id; ``seq`` 0 is the hello."""

    epoch: int
    seq: int


def actor_role(actor: int) -> str:
    """The role by which an actor takes epochs and says metrics."""
    return f"actor-{actor}"


class Entry(NamedTuple):
    """One stream entry as read by the replay server."""

    actor: int
    id: EntryId
    payload: bytes


class Ack(NamedTuple):
    """What the replay server committed of an actor's stream, and how far the actor may step.

    ``granted_steps`` counts agent steps of the actor in epoch ``id.epoch``. ``final``: the run's
    total is reached with them, so what is still open at that point should be sent, cut short.
    """

    id: EntryId
    granted_steps: int
    final: bool = False


UNTRAINED, TAKEN_OVER = 0, 1  # a version's updates before the run's first: of new networks, of another run's


class Version(NamedTuple):
    """A policy's version; readers take the highest."""

    epoch: int
    update: int


class ReplayOwner(NamedTuple):
    """A replay server in its epoch, by which the bus knows one that was replaced."""

    role: str
    epoch: int


class Bus(Protocol):
    """All that crosses between roles, except batches (they have a socket of their own).

    Every method may raise BusUnavailable (retry) and, where it writes, BusFull (wait).
    """

    refused: Counter[str]
    """What roles wrote and could not be read, by reason."""

    def take_epoch(self, role: str, floor: int = 0) -> int:
        """A new epoch of this role, larger than ``floor`` and than any taken before.

        At most ``MAX_EPOCH_GAP`` above ``floor``: more was counted by a stranger, and the counter is fixed.
        """

    def current_epoch(self, role: str) -> int:
        """The newest epoch taken by this role; 0 before the first."""

    def append(self, actor: int, entry_id: EntryId, payload: bytes) -> None:
        """Add an entry; one that is stored already is left as it is. Raises FencedError.

        A hello makes its epoch known where Redis has lost it: an entry of a larger one that nobody has taken fences
        nobody. BusUnavailable then says so until the replay server has dropped it.
        Only a hello makes a stream: where it is gone, BusUnavailable says that Redis has lost its data,
        and everything from the hello on is to be added again.
        """

    def actors(self) -> list[int]:
        """Ids of all actors that have appended anything."""

    def read(self, after: Mapping[int, EntryId], count: int) -> list[Entry]:
        """Up to ``count`` entries of each actor named in ``after``, past the id given, in order."""

    def commit(self, owner: ReplayOwner, acks: Mapping[int, Ack], progress: bytes = b"") -> None:
        """Publish acks and trim what they cover, unless a newer replay has come. Raises FencedError.

        ``progress``, where there is any, is kept for a replay server that has to begin with an empty ring.
        """

    def progress(self, role: str) -> bytes | None:
        """What that replay server last committed, as it said then."""

    def set_progress(self, role: str, progress: bytes) -> None:
        """Restore the counters of a replay server where Redis has none."""

    def drop_stream(self, owner: ReplayOwner, actor: int) -> None:
        """Make an actor send everything again from its hello on, unless a newer replay has come. Raises FencedError."""

    def ack(self, actor: int) -> Ack | None:
        """The newest ack for an actor."""

    def dead_letter(self, entry: Entry, reason: str) -> None:
        """Put a refused entry aside."""

    def announce_replay(self, owner: ReplayOwner, address: str) -> None:
        """Say where a replay server listens: ``unix:PATH`` or ``tcp:HOST:PORT``."""

    def replay_address(self, role: str) -> str | None:
        """Where that replay server listens, once it does."""

    def publish_weights(self, version: Version, blob: bytes, evaluate: bool = False) -> None:
        """Make a policy the newest that acts, or the newest that the evaluator should play. Raises FencedError."""

    def latest_version(self, evaluate: bool = False) -> Version | None:
        """Of the newest policy that acts, or of the newest to evaluate."""

    def weights(self, evaluate: bool = False) -> tuple[Version, bytes] | None:
        """The newest policy, or the newest to evaluate. None if there is none or it was just replaced."""

    def emit(self, role: str, record: Mapping[str, Any]) -> None:
        """Append a metrics record, see ``common/bus/metrics_record.py``."""

    def records(self, after: Mapping[str, str]) -> tuple[list[dict[str, Any]], dict[str, str]]:
        """Records of each role past its cursor ("0" = all that is kept), with a ``role``, and the next cursors.

        What is no record is left out.
        """

    def records_end(self, roles: Iterable[str]) -> dict[str, str]:
        """The cursors behind all that is kept now."""

    def memory_bytes(self) -> int:
        """What its server has allocated; 0 where there is none, or it does not say."""

    def request_stop(self, reason: str) -> None:
        """Ask every role to end."""

    def stop_requested(self) -> str | None:
        """Why the run should end, or None."""
