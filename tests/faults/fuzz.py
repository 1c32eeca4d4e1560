"""Messages that were changed at random: ``python -m tests.faults.fuzz [--tries 1000000]``.

Of each kind a lawful one is mutated, read by what reads it in a run, and either taken or refused by name: nothing else
may come of it, in no more than 10 ms, nor may memory grow. Mutations that keep a checksum right get past it. Proofs and
requests, with right checksums too, go to a replay server's socket.
"""

import logging
import random
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator

import msgpack
import numpy as np
import torch
from isal.isal_zlib import crc32
from safetensors.torch import save

from rmc.actors.policy_runner import PolicyRunner
from rmc.common.agent import Agent
from rmc.common.agent_config import AgentConfig
from rmc.common.bus.metrics_record import decode_record, encode_record
from rmc.common.bus.weight_store import join_pieces
from rmc.common.env.config import EnvConfig
from rmc.common.errors import ConfigError, MessageError
from rmc.common.replay import ObservationStatistics
from rmc.common.wire import HEADER, Kind, decode_header, decode_meta, encode_frame, encode_windows
from rmc.deploy.run.config import from_registration, to_json, to_registration
from rmc.deploy.run.presets import robust
from rmc.replay_server.commit_record import Progress, decode_published
from tests.faults.asked import LAWFUL_PROOF, Asked
from tests.faults.row import Row, at_length
from tests.replay_server.support import SPEC, lawful_rows, make_rows
from tests.runs import read_config

SLOWEST_S, MOST_MB = 0.010, 64
TAKEN = "taken"
ODD_VALUES = (
    None, True, -1, 0, 1, 7, 39, 2**31, 2**62, 2**63 - 1, 2**64 - 1, -(2**63), float("nan"), float("inf"), 1e308,
    "", "x", b"", bytes(32), [], [1] * 9, {},
)  # fmt: skip
AGENT = AgentConfig(hidden=8, embedding=6, heads=(7, 6), normalize_observations=True)
Reader = Callable[[bytes], object]
Case = tuple[str, bytes, Reader]  # a name, what is read, what reads it


def mutate(raw: bytes, rng: random.Random) -> bytes:
    """One to four changes: bytes, runs, cuts, copies of itself, lengths that lie."""
    changed = bytearray(raw)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(changed) + 1)
        match rng.randrange(7):
            case 0 if changed:
                changed[place % len(changed)] = rng.randrange(256)
            case 1 if changed:
                changed[place % len(changed)] ^= 1 << rng.randrange(8)
            case 2:
                del changed[place : place + rng.choice((1, 4, 64, 10**6))]
            case 3:
                changed[place:place] = rng.randbytes(rng.choice((1, 2, 8, 64)))
            case 4:
                start = rng.randrange(len(changed) + 1)
                changed[place:place] = changed[start : start + rng.choice((1, 8, 256))]
            case 5:
                changed[place : place + 4] = rng.choice(
                    (b"\xff" * 4, bytes(4), b"\x7f\xff\xff\xff", b"\xdd\xff\xff\xff")
                )
            case 6:
                changed[place : place + 8] = np.array(rng.choice((np.nan, np.inf, -1e308, 2.0**63))).tobytes()
    return bytes(changed)


def odd(raw: bytes, rng: random.Random) -> bytes:
    """A request, or a proof, with one or two values of another kind or size, or of another kind itself."""
    kind, packed = (raw[:1], raw[1:]) if raw != LAWFUL_PROOF else (b"", raw)
    meta = msgpack.unpackb(packed)
    for _ in range(rng.randint(1, 2)):
        meta[rng.choice([*meta, "batch_size", "count"])] = rng.choice(ODD_VALUES)
    if kind and rng.random() < 0.1:
        kind = rng.randbytes(1)
    return kind + msgpack.packb(meta)


def honest_window(body: bytes) -> None:
    """An entry whose header, length and checksum are right: what is within must be judged."""
    size = SPEC.dtype.itemsize
    rows = np.frombuffer(body[: len(body) // size * size].ljust(size, b"\0"), SPEC.dtype)
    lawful_rows(encode_windows(rows, SPEC))


def frame(raw: bytes) -> None:
    """As both ends of the replay server's socket read one: batches, priorities, statistics."""
    header = decode_header(raw[: HEADER.size].ljust(HEADER.size, b"\0"), 1 << 20)
    meta, body = raw[HEADER.size :][: header.meta_length], raw[HEADER.size + header.meta_length :]
    decode_meta(meta, body, header)


def weights(blob: bytes) -> None:
    """As an actor takes in a policy whose pieces are whole."""
    RUNNER.load(join_pieces([blob], crc32(blob)))


def proof(meta: bytes) -> None:
    """As a replay server hears a stranger."""
    ASKED.connect()
    ASKED.say_proof(meta)


def request(raw: bytes) -> None:
    """As it hears a learner; the first byte is the kind."""
    if not ASKED.known:
        ASKED.connect()
        ASKED.prove()
    kind = [*Kind][raw[0] % len(Kind)] if raw else Kind.STATISTICS
    ASKED.say(kind, raw[1:], b"".join(PRIORITIES) if kind is Kind.PRIORITIES else b"")


def published(raw: bytes) -> None:
    """Counters that a replay server begins with."""
    decode_published(raw, SPEC)


def _request(kind: Kind, meta: dict[str, int]) -> bytes:
    packed: bytes = msgpack.packb(meta)
    return bytes([[*Kind].index(kind)]) + packed


torch.manual_seed(0)
ASKED = Asked()
RUNNER = PolicyRunner(SPEC.obs_dim, SPEC.action_dim, AGENT, envs=1)
POLICY = save(Agent(SPEC.obs_dim, SPEC.action_dim, AGENT).policy_weights())
BODY = make_rows(4).tobytes()
PRIORITIES = (np.arange(8).tobytes(), np.ones(8, np.float32).tobytes())
KINDS: dict[str, tuple[bytes, Reader]] = {
    "window": (encode_windows(make_rows(4), SPEC), lawful_rows),
    "window, checksum right": (BODY, honest_window),
    "batch": (encode_frame(Kind.BATCH, {"total_weight": 1.0, "env_steps": 9}, (BODY,)) + BODY, frame),
    "priorities": (encode_frame(Kind.PRIORITIES, {"count": 8}, PRIORITIES) + b"".join(PRIORITIES), frame),
    "weights": (POLICY, weights),
    "proof": (LAWFUL_PROOF, proof),
    "sample": (_request(Kind.SAMPLE, {"batch_size": 4, "elsewhere": 9}), request),
    "priorities, checksum right": (_request(Kind.PRIORITIES, {"count": 8}), request),
    "episode": (_request(Kind.EPISODE, {"serial": 3}), request),
    "share": (_request(Kind.SHARE, {"batch_size": 4}), request),
    "record": (encode_record({"time": 1.5, "updates": 7, "waiting_for": "credit"}), decode_record),
    "config": (to_json(robust(EnvConfig("HalfCheetah-v5"))).encode(), read_config),
    "registration": (to_registration(robust(EnvConfig("HalfCheetah-v5"))), from_registration),
    "counters": (Progress(ObservationStatistics.none(SPEC)).publish(), published),
}


def cases(count: int, seed: int) -> Iterator[Case]:
    """So many, all kinds in turn."""
    rng, kinds = random.Random(seed), list(KINDS.items())
    for number in range(count):
        name, (lawful, reader) = kinds[number % len(kinds)]
        change = odd if reader in (proof, request) and rng.random() < 0.7 else mutate
        yield name, change(lawful, rng), reader


def peak_mb() -> float:
    """This process's largest memory so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def read(reader: Reader, raw: bytes) -> tuple[float, str]:
    """How long that took, in seconds of this process, and why it was refused."""
    started, reason = time.process_time(), TAKEN
    try:
        reader(raw)
    except MessageError as error:
        reason = error.reason
    except ConfigError:
        reason = "option"
    return time.process_time() - started, reason


def tried(fault: str, cases: Iterator[Case], count: int, slowest_s: float) -> Row:
    """Read these, ``count``. Raises whatever a reader raises that is no refusal."""
    before, refused, slow, slowest = peak_mb(), Counter[str](), 0, 0.0
    for name, raw, reader in cases:
        taken, reason = read(reader, raw)
        refused[f"{name}: {reason}"] += 1
        if taken > slowest_s:  # the message's fault, or the garbage collector's?
            taken = min(taken, *(read(reader, raw)[0] for _ in range(3)))
        slowest, slow = max(slowest, taken), slow + (taken > slowest_s)
    grown, over = peak_mb() - before, f"over_{1e3 * slowest_s:.0f}_ms"
    measured = {"slowest_ms": round(1e3 * slowest, 2), over: slow, "grown_mb": round(grown, 1), **refused}
    return Row(fault, count, slow == 0 and grown < MOST_MB, found=measured)


def fuzz(count: int, seed: int = 0) -> Row:
    """Read so many messages."""
    for lawful, reader in KINDS.values():
        reader(lawful)
    return tried("messages changed at random", cases(count, seed), count, SLOWEST_S)


if __name__ == "__main__":
    logging.disable(logging.WARNING)  # of every refusal
    at_length(__doc__, lambda tries, folder: iter([fuzz(tries)]), tries=1_000_000)
