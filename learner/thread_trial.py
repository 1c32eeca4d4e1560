"""How many threads an update takes: each number in turn, under the run's own load, and then the fastest."""

import logging
from collections.abc import Callable, Sequence
from itertools import chain, repeat
from statistics import median

log = logging.getLogger(__name__)
ROUNDS, TURN = 5, 60  # turns of each number; updates a turn
SETTLING = 5  # updates at a turn's start that do not count: caches, and batches begun before it


class ThreadTrial:
    """Tries numbers of threads while updates go on; ``chosen`` is 0 until it knows.

    One choice is taken untried; where there is none, nothing is changed.
    """

    def __init__(self, choices: Sequence[int], use: Callable[[int], None]) -> None:
        """``choices``, the smallest first; ``use`` sets the number."""
        self._use = use
        self._seconds: dict[int, list[float]] = {number: [] for number in choices}  # of each turn
        self._of_turn = 0.0  # seconds: whole turns compare, as not all updates train all losses
        self._turns = list(chain.from_iterable(repeat(number, TURN) for number in [*choices] * ROUNDS))
        self._updates = 0
        self.chosen = 0
        if len(choices) == 1:
            self._choose(choices[0])
        elif choices:
            use(choices[0])

    @property
    def found(self) -> int:
        """What a trial of this run or an earlier start chose; 0 where none was needed."""
        return self.chosen if len(self._seconds) > 1 else 0

    def take_up(self, number: int) -> None:
        """What an earlier start of the run chose, if it is a choice on this machine, too."""
        if number in self._seconds:
            self._choose(number)

    def _choose(self, number: int) -> None:
        self.chosen = number
        self._use(number)

    def note(self, seconds: float) -> None:
        """After an update that took so long."""
        if self.chosen or not self._turns:
            return
        number, place = self._turns[self._updates], self._updates % TURN
        if place >= SETTLING:
            self._of_turn += seconds
        if place == TURN - 1:
            self._seconds[number].append(self._of_turn / (TURN - SETTLING))
            self._of_turn = 0.0
        self._updates += 1
        if self._updates == len(self._turns):
            self._choose_fastest()
        elif place == TURN - 1:
            self._use(self._turns[self._updates])

    def _choose_fastest(self) -> None:
        took = {number: median(seconds) for number, seconds in self._seconds.items()}
        self._choose(min(took, key=lambda number: took[number]))
        measured = ", ".join(f"{1000 * seconds:.1f} ms with {number}" for number, seconds in took.items())
        log.info("threads of an update: %d (%s)", self.chosen, measured)
