"""Who may write in a run, asked on the cluster's head: ``python -m tests.cluster.epochs FOLDER HOST`` prints JSON.

For every actor: the epoch taken last, the epoch of what was acknowledged last, and whether Redis still refuses an entry
of the epoch before.
"""

import json
import sys
from pathlib import Path

from rmc.common.bus.protocol import EntryId
from rmc.common.bus.redis_bus import RedisBus
from rmc.common.errors import FencedError
from rmc.deploy.redis.users import LAUNCHER, RedisUsers
from rmc.deploy.run.folder import RunFolder


def is_refused(bus: RedisBus, actor: int, epoch: int) -> bool:
    """Whether an actor that has been replaced could add nothing more."""
    try:
        bus.append(actor, EntryId(epoch, 1 << 40), b"late")
    except FencedError:
        return True
    return False


def main(path: str, host: str) -> None:
    """Print them for the run in that folder, whose Redis is on that host."""
    folder = RunFolder(Path(path))
    port = (folder.path / "redis-port").read_text().strip()
    users = RedisUsers(folder.name, folder.secret(), folder.config().roles())

    def bus_of(user: str) -> RedisBus:
        return RedisBus(f"redis://{users.login(user)}{host}:{port}", folder.name)

    bus, epochs = bus_of(LAUNCHER), {}
    for actor in bus.actors():
        epoch, ack = bus.current_epoch(f"actor-{actor}"), bus.ack(actor)
        acked = ack.id.epoch if ack else 0
        epochs[actor] = {
            "epoch": epoch,
            "acked": acked,
            "refused": acked > 1 and is_refused(bus_of(f"actor-{actor}"), actor, acked - 1),
        }
    print(json.dumps(epochs))


if __name__ == "__main__":
    main(*sys.argv[1:])
