"""A headless Chromium: what starts it, and a page of it that a test talks to while it is open."""

import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
ANSWER_SECONDS, END_SECONDS = 60.0, 20.0


def command(profile: Path, *words: str) -> list[str]:
    """What starts it. Skips the test where there is none."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    usual = "--headless --no-sandbox --disable-gpu --disable-dev-shm-usage --enable-logging=stderr".split()  # noqa: SIM905
    return [CHROMIUM, *usual, f"--user-data-dir={profile}", *words]


class Page:
    """One, through Chromium's debugging pipe."""

    def __init__(self, to: int, back: int, url: str) -> None:
        self._to, self._back, self._rest, self._calls, self._session = to, back, b"", 0, {}
        target = self._call("Target.createTarget", url=url)["targetId"]
        self._session = {"sessionId": self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        self.seconds_until("location.href !== 'about:blank' && document.readyState === 'complete'")

    def js(self, expression: str) -> Any:
        """The value of an expression there."""
        answer = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def seconds_until(self, expression: str, most: float = 20.0) -> float:
        """How long it takes until an expression there is true."""
        began = time.monotonic()
        while not self.js(expression):
            assert time.monotonic() - began < most, (expression, self.js("document.body.innerText"))
            time.sleep(0.02)
        return time.monotonic() - began

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._calls += 1
        call = {"id": self._calls, "method": method, "params": params, **self._session}
        os.write(self._to, json.dumps(call).encode() + b"\0")
        while (answer := self._message()).get("id") != self._calls:
            pass
        return dict(answer["result"])

    def _message(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            assert select.select([self._back], [], [], ANSWER_SECONDS)[0], "the browser says nothing"
            self._rest += os.read(self._back, 1 << 20)
        message, _, self._rest = self._rest.partition(b"\0")
        return dict(json.loads(message))


@contextmanager
def opened(url: str, folder: Path) -> Iterator[Page]:
    """A page at a URL. Nothing may go wrong in its scripts."""
    (its_in, to), (back, its_out), log = os.pipe(), os.pipe(), folder / "browser.log"
    words = ["bash", "-c", f'exec "$@" 3<&{its_in} 4>&{its_out}', "bash"]
    words += command(folder / "profile", "--remote-debugging-pipe", "--window-size=1280,900")
    with log.open("wb") as errors:
        process = subprocess.Popen(words, pass_fds=(its_in, its_out), stdout=errors, stderr=errors)
    os.close(its_in), os.close(its_out)
    try:
        yield Page(to, back, url)
    finally:
        its_own = psutil.Process(process.pid).children(recursive=True)
        os.close(to), os.close(back)  # then it ends
        try:
            process.wait(END_SECONDS)
        finally:
            process.kill()
            process.wait()
            psutil.wait_procs(its_own, END_SECONDS)
    assert "Uncaught" not in log.read_text(errors="replace"), log.read_text(errors="replace")
