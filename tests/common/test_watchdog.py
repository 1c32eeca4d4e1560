"""A process that hangs ends, and says where it hung."""

import subprocess
import sys
import time

IMPORTS = "import time\nfrom rmc.common.process.watchdog import Watchdog\n"


def run(code: str) -> tuple[int, str, float]:
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS + code], capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stderr, time.monotonic() - start


def test_a_hanging_process_dies_with_its_traceback() -> None:
    status, said, seconds = run("Watchdog(0.5).beat()\ndef stuck(): time.sleep(50)\nstuck()")
    assert status == 1
    assert "Timeout" in said
    assert "in stuck" in said
    assert seconds < 30


def test_it_watches_no_more_while_it_sleeps_and_again_afterwards() -> None:
    code = "dog = Watchdog(0.5)\nwith dog.asleep(): time.sleep(0.7)\ntime.sleep(0.7)\ndog.beat()\n"
    assert run(code + "with dog.asleep(): time.sleep(1.0)\nprint()\ndog.close()")[:2] == (0, "")
    status, said, seconds = run(code + "with dog.asleep(): pass\ndef stuck(): time.sleep(50)\nstuck()")
    assert (status, "in stuck" in said) == (1, True)
    assert seconds < 30


def test_one_that_beats_lives_and_one_that_closed_may_take_its_time() -> None:
    code = "dog = Watchdog(1.0)\nfor _ in range(20):\n    dog.beat()\n    time.sleep(0.1)\ndog.close()\ntime.sleep(1.5)"
    assert run(code)[:2] == (0, "")
