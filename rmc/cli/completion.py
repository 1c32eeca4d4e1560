"""``rmc completion``: a shell's script, which the option parser's library writes, and which completes files too."""

import contextlib
import io
import sys

from rmc.cli import parser
from rmc.cli.run_options import Completion

# The library's scripts know of files after options alone. Where they find nothing, the shell looks for files.
FILES = {
    "bash": """
_rmc_or_files() {
  _tyro_rmc "$@"
  [[ -n "${COMPREPLY[*]}" ]] || COMPREPLY=()
}
complete -o default -F _rmc_or_files rmc
""",
    "zsh": " || _files\n",
    "fish": "",
}


def print_script(command: Completion) -> int:
    """Print it."""
    with contextlib.redirect_stdout(io.StringIO()) as script, contextlib.suppress(SystemExit):
        parser.parse(["--tyro-print-completion", command.shell])
    text = script.getvalue()
    sys.stdout.write((text.rstrip() if command.shell == "zsh" else text) + FILES[command.shell])
    return 0
