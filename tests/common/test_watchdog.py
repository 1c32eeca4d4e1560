"""A process in which an environment's call hangs ends, and says which, where and after how long."""

import os
import signal
import subprocess
import sys
import time

import pytest

from rmc.common.process.watchdog import HUNG_STATUS, EnvCall

IMPORTS = "import ctypes, os, time\nfrom rmc.common.process.watchdog import *\n"
LINE = "rmc: ENV='Mine-v0': step has not returned for 0.5 s (<string>, line 5); fix it, or raise --env-timeout\n"
STUCK = "def stuck(): ctypes.PyDLL(None).sleep(50)\nwith call: stuck()"
WATCHED = "start()\ncall = EnvCall('Mine-v0', 'step', 0.5)\n"


def run(code: str) -> tuple[int, str, float]:
    start = time.monotonic()
    words = [sys.executable, "-c", IMPORTS + code]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, done.stderr, time.monotonic() - start


def test_a_hanging_call_is_named_and_ends_its_process() -> None:
    status, output, seconds = run(WATCHED + "with call: time.sleep(50)")
    assert (status, output) == (HUNG_STATUS, LINE)
    assert seconds < 30


def test_another_stderr_does_not_keep_it_from_looking() -> None:
    code = "for _ in range(12):\n    with EnvCall('', 'reset', 0.5): time.sleep(0.1)"
    assert run(WATCHED + "import io, sys\nsys.stderr = io.StringIO()\n" + code)[:2] == (0, "")


def test_what_was_printed_before_is_not_lost() -> None:
    words = [sys.executable, "-c", IMPORTS + WATCHED + "print('before')\nwith call: time.sleep(50)"]
    assert subprocess.run(words, stdout=subprocess.PIPE, timeout=60, check=False).stdout == b"before\n"


@pytest.mark.parametrize("before", ["", "with call: time.sleep(0.3)\ntime.sleep(0.3)\n"], ids=["at once", "later"])
def test_one_that_hangs_in_c_with_pythons_lock_leaves_a_traceback(before: str) -> None:
    status, output, seconds = run(WATCHED + before + STUCK)
    assert status == 1
    assert "Timeout" in output
    assert "in stuck" in output
    assert seconds < 30


def test_calls_that_return_may_be_many_and_time_between_them_does_not_count() -> None:
    assert run(WATCHED + "with call: pass\ntime.sleep(1.5)")[:2] == (0, "")
    code = "for _ in range(12):\n    with EnvCall('', 'reset', 0.5): time.sleep(0.1)\ntime.sleep(1.5)\n"
    assert run(WATCHED + code)[:2] == (0, "")
    assert run(
        WATCHED + "with call:\n    for _ in range(12):\n        with EnvCall('', 'reset', 0.5): time.sleep(0.1)"
    )[:2] == (0, "")


@pytest.mark.parametrize(("name", "status"), [("close", 0), ("step", 1)])
def test_what_keeps_pythons_lock_after_an_environment_is_closed_has_not_hung(name: str, status: int) -> None:
    """An import of torch on a slow disk; after a step it would have."""
    code = f"start()\nwith EnvCall('Mine-v0', {name!r}, 0.5): time.sleep(0.2)\nctypes.PyDLL(None).sleep(2)"
    assert run(code)[0] == status


def test_in_a_users_own_process_it_is_a_warning_once_and_nothing_ends() -> None:
    status, output, _ = run("warn()\nwarn()\ncall = EnvCall('Mine-v0', 'step', 0.5)\n\nwith call: time.sleep(2)")
    assert (status, output) == (0, LINE.removeprefix("rmc: ").replace("line 5", "line 7"))
    threads = (  # that leave in the order in which they came
        "import threading\ndef play(after, seconds):\n    time.sleep(after)\n"
        "    with EnvCall('', 'reset', 0.5): time.sleep(seconds)\n"
        "for one in [threading.Thread(target=play, args=(0.1 * i, 0.3)) for i in range(3)]: one.start()\ntime.sleep(2)"
    )
    assert run(f"warn()\n{threads}")[:2] == (0, "")
    quick = "for _ in range(12):\n    with EnvCall('', 'reset', 0.5): time.sleep(0.1)"
    assert run(f"warn()\n{quick}")[:2] == (0, "")


def test_calls_of_two_threads_leave_no_chain_behind_them() -> None:
    for _ in range(100):
        first, second = EnvCall("Mine-v0", "step", 1.0), EnvCall("Mine-v0", "step", 1.0)
        first.__enter__()
        second.__enter__()
        first.__exit__()
        second.__exit__()
    assert EnvCall.current is first
    assert first._outer is None
    EnvCall.current = None


def test_a_process_that_does_not_start_it_is_not_watched() -> None:
    assert run("with EnvCall('Mine-v0', 'step', 0.2): time.sleep(1.0)")[:2] == (0, "")


def test_a_process_that_is_suspended_has_not_hung() -> None:
    """As by Ctrl-Z, for longer than a call may take."""
    code = (
        IMPORTS + "start()\nwith EnvCall('Mine-v0', 'step', 1.0):\n    print('in', flush=True)\n    time.sleep(0.5)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "in\n"
    process.send_signal(signal.SIGTSTP)
    assert os.WIFSTOPPED(os.waitpid(process.pid, os.WUNTRACED)[1])
    time.sleep(2.5)
    process.send_signal(signal.SIGCONT)
    _, output = process.communicate(timeout=30)
    assert (process.returncode, output) == (0, "")
