"""rmc as a process of its own."""

import subprocess
import sys
from pathlib import Path

COMMAND = (sys.executable, "-m", "rmc.cli.main")


def rmc(
    *words: str, timeout: float = 120, cwd: Path | None = None, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """What it prints and how it ends; raises TimeoutExpired after so many seconds."""
    return subprocess.run(
        [*COMMAND, *words], cwd=cwd, env=env, capture_output=True, text=True, timeout=timeout, check=False
    )
