"""The commands of the pages as they are printed, in this process: it has imported already what they need."""

import io
import logging
import re
import shlex
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

from rmc.cli import main

DOCS = Path(__file__).parents[2] / "docs"
LOCKSTEP = ("--launcher", "lockstep")


def commands(page: str) -> list[list[str]]:
    """What follows ``rmc`` in each of its lines that are one, in their order."""
    blocks = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", "").splitlines()
    return [shlex.split(line)[1:] for line in lines if line.startswith("rmc ")]


def ran(folder: Path, *words: str, warning: str = "") -> str:
    """What a command prints there; it must end well, and complain of nothing but, as a pattern, ``warning``."""
    output, errors = io.StringIO(), io.StringIO()
    logged = logging.StreamHandler(errors)
    logged.setLevel(logging.WARNING)
    logging.getLogger().addHandler(logged)
    try:
        with chdir(folder), redirect_stdout(output), redirect_stderr(errors):
            status = main.run(list(words))
    finally:
        logging.getLogger().removeHandler(logged)
    complained = errors.getvalue().strip()
    assert (status, bool(re.fullmatch(warning, complained))) == (0, True), output.getvalue() + complained
    return output.getvalue()
