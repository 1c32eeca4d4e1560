"""Updates a second of a run while 100 pages of ``rmc watch`` are open, beside without them and their server.

    python -m benchmarks.pages [--env HalfCheetah-v5] [--pages 100] [--rounds N] [--seconds S]

The pages are connections that read all their events, on the same two cores. Needs the extra ``watch``.
"""

import selectors
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from benchmarks.harness import argument_parser, compare, save
from benchmarks.update_time import training, updates_per_s

SETTLE_SECONDS = 5.0  # a server starts; connections are told everything


@contextmanager
def served(run: Path) -> Iterator[int]:
    """``rmc watch`` of a run: its port."""
    words = [sys.executable, "-m", "rmc.cli.main", "watch", str(run), "--port", "0"]
    server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        yield urlsplit(server.stdout.readline().strip()).port or 0
    finally:
        server.terminate()
        server.wait()


@contextmanager
def pages(port: int, count: int) -> Iterator[None]:
    """So many connections that take every event, as a browser's page does."""
    ready, is_over = selectors.DefaultSelector(), threading.Event()

    def receive() -> None:
        while not is_over.is_set():
            for key, _ in ready.select(0.1):
                if not key.fileobj.recv(1 << 16):  # type: ignore[union-attr]
                    raise ConnectionError("rmc watch has closed a page")

    with ExitStack() as leave:
        for _ in range(count):
            page = leave.enter_context(socket.create_connection(("127.0.0.1", port)))
            page.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            ready.register(page, selectors.EVENT_READ)
        reader = threading.Thread(target=receive)
        reader.start()
        try:
            yield
            assert reader.is_alive(), "a page was closed"
        finally:
            is_over.set()
            reader.join()


def speed(run: Path, seconds: float) -> float:
    """Updates a second, from when all has settled."""
    time.sleep(SETTLE_SECONDS)
    began = time.time()
    time.sleep(seconds)
    return updates_per_s(run, lambda one: one["time"] >= began)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.set_defaults(seconds=20.0)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--pages", type=int, default=100)
    options = parser.parse_args()
    with training(sys.executable, options.env) as (run, _):

        def watched() -> float:
            with served(run) as port, pages(port, options.pages):
                return speed(run, options.seconds)

        name = f"a run beside {options.pages} open pages, {options.env}"
        without = {"no page open": lambda: speed(run, options.seconds)}
        save(compare(name, "updates/s", watched, without, rounds=options.rounds))


if __name__ == "__main__":
    main()
