"""``rmc hub`` as dataclasses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rmc.cli.run_options import Checkpoint, Run

Repo = Annotated[Positional[str], tyro.conf.arg(metavar="REPO")]


@dataclass(frozen=True)
class Push:
    """Put a policy and its model card into a repository of the Hugging Face hub."""

    run: Run
    """The run's folder, or a policy file."""
    repo: Repo
    """owner/name; made where it is not there."""
    checkpoint: Checkpoint = "latest"
    license: str | None = None
    """What the model card says, like mit or cc-by-4.0; by default nothing."""
    private: bool = False
    """Make the repository private, if it is new."""


@dataclass(frozen=True)
class Pull:
    """Get a policy from a repository of the Hugging Face hub."""

    repo: Repo
    """owner/name."""
    out: Path = Path("policy.safetensors")
    """The file to write."""
    revision: str | None = None
    """A branch, tag or commit; by default the newest."""


@dataclass(frozen=True)
class Hub:
    """Share policies on the Hugging Face hub."""

    action: Annotated[Push, tyro.conf.subcommand("push")] | Annotated[Pull, tyro.conf.subcommand("pull")]
