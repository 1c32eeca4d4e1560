"""What is printed goes elsewhere for a while, whoever prints it."""

import subprocess
import sys

PROGRAM = """
import ctypes
from rmc.common.process.redirect import redirected

print("before")
with redirected({1: 2}):
    ctypes.CDLL(None).puts(b"from C")
    print("from Python")
print("after")
"""


def test_what_c_code_prints_goes_there_too_and_nothing_before_or_after() -> None:
    command = [sys.executable, "-E", "-c", PROGRAM]  # PYTHONUNBUFFERED is for C, too
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "before\nafter\n"
    assert sorted(done.stderr.splitlines()) == ["from C", "from Python"]
