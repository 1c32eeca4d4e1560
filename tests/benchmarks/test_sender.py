"""What a simulated actor sends is taken, however long its windows are."""

import pytest

from benchmarks.sender import CHUNK, Sender
from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import EntryId
from rmc.common.window import WindowSpec
from rmc.common.wire import decode_rows


@pytest.mark.parametrize(("steps", "windows"), [(25, CHUNK), (20_000, 1), (2_000, 8)])
def test_an_entry_is_no_larger_than_an_actors(steps: int, windows: int) -> None:
    spec, bus = WindowSpec(obs_dim=12, action_dim=3, state=16, burn_in=10, train=steps - 10), MemoryBus()
    Sender(bus, spec).send()
    _, sent = bus.read({0: EntryId(0, -1)}, 2)
    assert len(decode_rows(sent.payload, spec)) == windows
