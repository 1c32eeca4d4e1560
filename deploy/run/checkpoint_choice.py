"""Which of a run's checkpoints is meant: ``latest``, ``best`` or a number."""

from rmc.common.checkpoint import CheckpointFolder
from rmc.common.errors import CheckpointError, ConfigError
from rmc.deploy.run.folder import RunFolder
from rmc.deploy.run.state import remedy


def choose_checkpoint(folder: RunFolder, which: str) -> tuple[int, dict[str, bytes]]:
    """Its number and files, verified. Raises ConfigError where there is none or it is damaged."""
    checkpoints, number = CheckpointFolder(folder.checkpoints), checkpoint_number(folder, which)
    try:
        return number, checkpoints.load(number)
    except CheckpointError as error:
        others = [other for other in checkpoints.numbers() if other != number]
        fix = f"use one of {others}" if others else "there is no other"
        raise ConfigError("--checkpoint", str(which), f"{error}; {fix}") from None


def checkpoint_number(folder: RunFolder, which: str) -> int:
    """Its number, which stays the same while a run goes on to others. Raises ConfigError where there is none."""
    checkpoints, which = CheckpointFolder(folder.checkpoints), str(which)
    numbers = checkpoints.numbers()
    if not numbers:
        raise ConfigError("RUN", str(folder.path), f"it has no checkpoint yet; {remedy(folder)}")
    if which == "latest":
        return numbers[-1]
    if which == "best":
        best = checkpoints.best()
        if best is None or best not in numbers:
            raise ConfigError("--checkpoint", which, "none was evaluated whole yet; use latest")
        return best
    if which.isdecimal() and int(which) in numbers:
        return int(which)
    raise ConfigError("--checkpoint", which, f"use latest, best or one of {numbers}")
