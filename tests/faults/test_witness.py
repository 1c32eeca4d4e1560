"""What is seen from outside is compared only within one Redis."""

from rmc.common.bus.memory_bus import MemoryBus
from rmc.common.bus.protocol import Ack, EntryId
from tests.faults.witness import Witness


class Restarted(MemoryBus):
    """Another Redis, which knows less, takes its place while it is looked at."""

    newest, witness = 9, Witness(2)

    def ack(self, actor: int) -> Ack | None:
        if actor == 0 and self.newest == 5:
            self.witness.redis_came_back()
            self.newest = 3
        return Ack(EntryId(1, self.newest), 0, False)


def test_acks_of_another_redis_are_not_compared() -> None:
    bus, witness = Restarted(), Restarted.witness
    witness._look(bus)
    bus.newest = 5  # from here on amid a look
    witness._look(bus)
    assert witness.acks_went_back == 0
    witness._look(bus)
    assert witness.acks_went_back == 0
    bus.newest = 2
    witness._look(bus)
    assert witness.acks_went_back == 2
