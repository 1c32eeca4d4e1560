"""What the replay server's tests share: a small window, lawful rows, an actor's end of the bus, a server's state."""

from collections.abc import Callable, Sequence

import numpy as np

from rmc.common.bus.protocol import Bus, EntryId
from rmc.common.errors import MessageError
from rmc.common.window import Rows, WindowSpec
from rmc.common.wire import decode_rows, encode_hello, encode_windows
from rmc.replay_server.config import ReplayConfig
from rmc.replay_server.row_check import FAULTS, row_faults
from rmc.replay_server.server import ReplayServer

Make = Callable[..., ReplayServer]
OPEN = ReplayConfig(capacity=100, replay_ratio=1e6, warmup_steps=0)  # the limiter never holds anything back
SPEC = WindowSpec(obs_dim=3, action_dim=2, state=4, burn_in=2, train=4)


def make_rows(count: int, first_mark: int = 0, spec: WindowSpec = SPEC) -> Rows:
    """Full windows that each carry ``train`` new steps; reward[0] is a running mark that names the window."""
    rows = np.zeros(count, spec.dtype)
    marks = np.arange(first_mark, first_mark + count)
    rows["first"], rows["last"] = spec.burn_in, spec.steps  # each begins an episode
    rows["new_steps"] = rows["new_observations"] = spec.train
    phase = np.arange(spec.observations * spec.obs_dim).reshape(spec.observations, spec.obs_dim)
    rows["observation"] = np.sin(marks[:, None, None] + phase)
    rows["reward"][:, 0] = marks
    return rows


def write_steps(rows: Rows, episodes: Sequence[int]) -> None:
    """Observations and actions name episode and step, so that windows of one episode hold the same at the same step."""
    steps = rows["episode_step"][:, None] + np.arange(SPEC.observations) - SPEC.burn_in
    names = (1000.0 * np.array(episodes)[:, None] + steps)[..., None]
    rows["observation"], rows["action"] = names, np.cos(names[:, :-1])
    rows["first"] = np.where(rows["episode_step"] >= SPEC.burn_in, 0, SPEC.burn_in)


def lawful_rows(payload: bytes, spec: WindowSpec = SPEC) -> Rows:
    """Rows of an entry as intake reads and judges them. Raises MessageError."""
    rows = decode_rows(payload, spec).copy()
    faults = row_faults(rows, spec)
    if faults.any():
        raise MessageError("window", FAULTS[faults.max()])
    return rows


class Sender:
    """An actor as the replay server sees it: a hello, then entries in order."""

    def __init__(self, bus: Bus, actor: int = 0, spec: WindowSpec = SPEC) -> None:
        self.bus, self.actor, self.spec, self.marks = bus, actor, spec, 0
        self.hello()

    def hello(self) -> None:
        """Begin a life."""
        self.epoch, self.seq = self.bus.take_epoch(f"actor-{self.actor}"), 0
        self.greet()

    def greet(self) -> None:
        """Append this life's hello, or append it again because Redis has lost it."""
        self.bus.append(self.actor, EntryId(self.epoch, 0), encode_hello(self.spec))

    def send(self, count: int) -> None:
        """One entry of ``count`` new windows."""
        self.send_rows(make_rows(count, self.marks, self.spec))
        self.marks += count

    def send_rows(self, rows: Rows) -> None:
        self.send_raw(encode_windows(rows, self.spec))

    def send_raw(self, payload: bytes) -> None:
        self.seq += 1
        self.bus.append(self.actor, EntryId(self.epoch, self.seq), payload)

    def granted(self) -> int:
        """Steps that the newest ack allows in this life."""
        ack = self.bus.ack(self.actor)
        return ack.granted_steps if ack is not None and ack.id.epoch == self.epoch else 0


def close(server: ReplayServer) -> None:
    """Close once, however often it is called."""
    if server._store.lock >= 0:
        server.close()
        server._store.lock = -1


def drain(server: ReplayServer) -> None:
    """Until there is nothing more to take in."""
    while server.step():
        pass


def filled(server: ReplayServer, bus: Bus, windows: int) -> tuple[ReplayServer, Sender]:
    """It, and an actor that has sent it so many windows in an entry."""
    sender = Sender(bus)
    sender.send(windows)
    drain(server)
    return server, sender


def stored(server: ReplayServer) -> np.ndarray:
    """All windows that may be sampled, by serial."""
    progress = server._store.ring.progress
    serials = np.arange(progress.valid_from, progress.next_serial)
    rows = server._store.ring.rows[serials % server._store.ring.capacity]
    assert rows["serial"].tolist() == serials.tolist()
    return rows
