"""Every window that a ring ever commits, noted before newer ones overwrite it, while others have it open."""

from itertools import pairwise

import numpy as np

from rmc.common.window import Rows
from rmc.deploy.run.folder import RunFolder
from rmc.replay_server.ring import _records, _rows_start

NOTED = ("serial", "seq", "weights_update", "actor", "epoch", "k", "env", "episode_step", "new_steps")


class Ledger:
    """Of a run with one ring, which is there. Reads, and never writes, but for ``damage``."""

    def __init__(self, run: RunFolder) -> None:
        config, path = run.config(), run.path / "replay" / "ring"
        spec = config.window_spec()
        self._capacity, start = config.replay.capacity, _rows_start(spec)
        self._records = _records(np.memmap(path, np.uint8, "r", shape=(start,)), spec)
        self._rows = np.memmap(path, spec.dtype, "r+", offset=start, shape=(self._capacity,)).view(np.ndarray)
        fields = spec.dtype.fields
        assert fields is not None
        self._noted: list[Rows] = [np.zeros(0, np.dtype([(name, fields[name][0]) for name in NOTED]))]
        self.seen, self.missed = 0, 0  # the next serial to note; windows that came and went between two looks
        self.env_steps = 0
        self._replay_epoch = self.epochs_went_back = 0

    def look(self) -> None:
        """Note what was committed since the last look."""
        if (progress := self._records.read()) is None or progress.next_serial <= self.seen:
            return
        self.epochs_went_back += progress.replay_epoch < self._replay_epoch
        self._replay_epoch, self.env_steps = progress.replay_epoch, progress.env_steps
        serials = np.arange(max(self.seen, progress.valid_from), progress.next_serial)
        part = np.empty(len(serials), self._noted[0].dtype)
        for name in NOTED:
            part[name] = self._rows[name][serials % self._capacity]
        now = self._records.read()
        whole = (part["serial"] == serials) & (serials >= (now.valid_from if now is not None else progress.next_serial))
        self.missed += progress.next_serial - self.seen - int(whole.sum())
        self.seen = progress.next_serial
        self._noted.append(part[whole])

    def rows(self) -> Rows:
        """(n,) windows in the order of their serials, of each where it comes from alone."""
        self._noted = [np.concatenate(self._noted)]
        return self._noted[0]

    def disordered(self) -> int:
        """Windows that do not come after the one before of the same actor, by epoch, entry and place in it."""
        rows, found = self.rows(), 0
        for actor in np.unique(rows["actor"]):
            own = rows[rows["actor"] == actor][["epoch", "seq", "k"]].tolist()
            found += sum(later <= earlier for earlier, later in pairwise(own))
        return found

    def damage(self, chance: float) -> int | None:
        """Change a byte of a window that was noted, and will stay for a while; its serial, None where there is none."""
        oldest = max(0, self.seen - self._capacity // 2)
        if self.seen == oldest:
            return None
        serial = oldest + int(chance * (self.seen - oldest))
        raw = self._rows.view(np.uint8).reshape(self._capacity, -1)[serial % self._capacity]
        raw[int(chance * 1e6) % len(raw)] ^= 1 << int(chance * 1e9) % 8
        return serial
