"""The files of a run's checkpoint, by what a user calls it: latest, best or its number."""

from rmc.common.checkpoint import STATE, CheckpointFolder
from rmc.common.errors import CheckpointError, ConfigError
from rmc.deploy.run.folder import RunFolder


def load_files(folder: RunFolder, checkpoint: str) -> dict[str, bytes]:
    """All of them. Raises ConfigError, which names the checkpoints that there are.

    The best is of those that were evaluated while it trained, which the last one need not be.
    """
    checkpoints = CheckpointFolder(folder.checkpoints)
    number = _number(checkpoints, checkpoint)
    try:
        return checkpoints.load(number)
    except CheckpointError as error:
        others = [other for other in checkpoints.numbers() if other != number]
        fix = f"use one of {others}" if others else "there is no other"
        raise ConfigError("--checkpoint", checkpoint, f"{error}; {fix}") from None


def load_state(folder: RunFolder, checkpoint: str) -> bytes:
    """The learner's whole state of a checkpoint, for ``torch.load``. Raises ConfigError."""
    return load_files(folder, checkpoint)[STATE]


def _number(checkpoints: CheckpointFolder, which: str) -> int:
    numbers = checkpoints.numbers()
    if not numbers:
        raise ConfigError("RUN", str(checkpoints.folder.parent), "it has no checkpoint yet; train it for longer")
    if which == "latest":
        return numbers[-1]
    if which == "best":
        best = checkpoints.best()
        if best is None or best not in numbers:
            raise ConfigError("--checkpoint", which, "none was evaluated yet; use latest")
        return best
    if which.isdecimal() and int(which) in numbers:
        return int(which)
    raise ConfigError("--checkpoint", which, f"use latest, best or one of {numbers}")
