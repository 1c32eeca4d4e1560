"""``Shard``: one replay server of several, and whose streams it reads."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Shard:
    """Which of the replay servers that share a run's actors: those whose id is ``index`` mod ``count`` are its own."""

    index: int = 0
    count: int = 1

    @property
    def role(self) -> str:
        """The replay server's name: ``replay``, or ``replay-0`` and so on."""
        return "replay" if self.count == 1 else f"replay-{self.index}"

    def owns(self, actor: int) -> bool:
        return actor % self.count == self.index

    def part(self, whole: int, actors: int) -> int:
        """This shard's part of a whole number that is split by actors; all parts add up to it."""
        before = sum(len(range(index, actors, self.count)) for index in range(self.index))
        own = len(range(self.index, actors, self.count))
        return whole * (before + own) // actors - whole * before // actors


WHOLE = Shard()  # where there is but one replay server
