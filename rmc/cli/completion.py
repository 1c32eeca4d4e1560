"""``rmc completion``: a shell's script, which the option parser's library writes, and which completes files too."""

import contextlib
import io
import sys

from rmc.cli import parser
from rmc.cli.run_options import Completion

# What the option parser's library writes, and what is fixed in it.
MENDED = {
    # each line of a description was a candidate; and options were, for a word that has not begun
    "        print(completion)\n": """        if completion[:1] != '-' or ''.join(words[current_index:])[:1] == '-':
            print(*completion.splitlines())
""",
    "$words $current)": "$words (commandline -ct) $current)",  # fish: the word that is typed was missing
    "  local -a completion_array\n": "  [[ -n $completions ]] || return 1\n  local -a completion_array\n",  # zsh
}
# The scripts know of files after options alone. Where they find nothing, the shell looks for files.
FILES = {
    "bash": """
_rmc_or_files() {
  _tyro_rmc "$@"
  [[ -n "${COMPREPLY[*]}" ]] || COMPREPLY=()
}
complete -o default -F _rmc_or_files rmc
""",
    "zsh": " || _files\n",
    "fish": """
function _rmc_or_files
    set -l results (_tyro_rmc)
    if test -n "$results"
        printf "%s\\n" $results
    else
        __fish_complete_path (commandline -ct)
    end
end
complete --erase --command rmc
complete --no-files --command rmc --arguments "(_rmc_or_files)"
""",
}


def print_script(command: Completion) -> int:
    """Print it."""
    with contextlib.redirect_stdout(io.StringIO()) as script, contextlib.suppress(SystemExit):
        parser.parse(["--tyro-print-completion", command.shell])
    text = script.getvalue()
    for theirs, ours in MENDED.items():
        text = text.replace(theirs, ours)
    sys.stdout.write((text.rstrip() if command.shell == "zsh" else text) + FILES[command.shell])
    return 0
