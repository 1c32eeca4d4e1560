"""A proxy in front of a socket, TCP or unix, whose weather changes: late, piece by piece, cut after any byte.

What comes with the bytes, as file descriptors do on a unix socket, passes, too.
"""

import os
import random
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

LOOK_SECONDS = 0.01
RESET = struct.pack("ii", 1, 0)  # SO_LINGER: TCP's reset in place of an orderly end
MOST_BYTES, MOST_DESCRIPTORS = 65_536, 4


@dataclass(frozen=True)
class Weather:
    """What happens to bytes on their way, both ways."""

    late: float = 0.0  # seconds that what has arrived at once waits
    piece: int = MOST_BYTES  # bytes that are passed on at a time
    cut: int = 0  # a connection is reset after a random number of bytes below this one; 0: it is not


CALM = Weather()


class Proxy:
    """Listens until ``close``; ``target`` is where the other end listens at that moment: a unix socket."""

    def __init__(self, listener: socket.socket, target: Callable[[], Path]) -> None:
        self.weather = CALM
        self.connections = self.cuts = 0
        self._listener, self._target = listener, target
        self.address = listener.getsockname()  # (host, port), or a unix socket's path
        self._links: set[_Link] = set()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:  # closed
                return
            server = socket.socket(socket.AF_UNIX)
            try:
                server.connect(str(self._target()))
            except OSError:  # nobody there: whoever came hears what it would have heard
                _close(client, server, reset=True)
                continue
            self.connections += 1
            self._links.add(_Link(self, client, server))

    def forget(self, link: "_Link") -> None:
        """It has ended."""
        self._links.discard(link)

    def close(self) -> None:
        """End the listener and every connection."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes who accepts
        self._listener.close()
        for link in list(self._links):
            link.cut()


class _Link:
    """A client's connection and the server's behind it."""

    def __init__(self, proxy: Proxy, client: socket.socket, server: socket.socket) -> None:
        self._proxy, self._ends = proxy, (client, server)
        self._weather, self._left = CALM, 0  # bytes until it is cut
        self._running, self._broken = 2, False
        self._lock = threading.Lock()
        if client.family == socket.AF_INET:
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for ends in ((client, server), (server, client)):
            threading.Thread(target=self._pump, args=ends, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        """One way, to its end; who is last closes both."""
        try:
            while self._pass_some(source, sink):
                pass
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            self.cut()
        with self._lock:
            self._running -= 1
            last = not self._running
        if last:
            self._proxy.forget(self)
            _close(*self._ends, reset=self._broken)

    def _pass_some(self, source: socket.socket, sink: socket.socket) -> bool:
        """What has arrived, as the weather is; False at the end. Raises ConnectionResetError where it is cut."""
        data, descriptors, _, _ = socket.recv_fds(source, MOST_BYTES, MOST_DESCRIPTORS)
        try:
            weather = self._proxy.weather
            time.sleep(weather.late if data else 0.0)
            passed = data[: self._until_cut(weather, len(data))]
            if descriptors and passed:
                socket.send_fds(sink, [passed[:1]], descriptors)
            for start in range(bool(descriptors), len(passed), weather.piece):
                sink.sendall(passed[start : start + weather.piece])
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        if len(passed) < len(data):
            self._proxy.cuts += 1
            raise ConnectionResetError
        return bool(data)

    def _until_cut(self, weather: Weather, size: int) -> int:
        """How many of so many bytes still pass."""
        with self._lock:
            if weather != self._weather:
                self._weather, self._left = weather, random.randrange(max(1, weather.cut))
            if not weather.cut:
                return size
            passed = min(size, self._left)
            self._left -= passed
            return passed

    def cut(self) -> None:
        """Reset both ends, whatever is on its way; wakes both directions, which then close."""
        self._broken = True
        for end in self._ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RD)


def _close(*ends: socket.socket, reset: bool) -> None:
    for end in ends:
        with suppress(OSError):
            if reset:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        end.close()


def tcp_proxy(target: Path) -> Proxy:
    """On a free port of 127.0.0.1, before a unix socket."""
    return Proxy(socket.create_server(("127.0.0.1", 0)), lambda: target)


class Interposed:
    """A proxy in the place of a unix socket that others make, and make again: that one is renamed, and goes on."""

    def __init__(self, place: Callable[[], Path | None]) -> None:
        """``place``: where that socket is now, if there is one."""
        self.placed = 0  # how often so
        self._connections = self._cuts = 0  # of proxies before the present one
        self._place, self._weather = place, CALM
        self._proxy: Proxy | None = None
        self._ours = -1
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    @property
    def connections(self) -> int:
        """So far."""
        return self._connections + (self._proxy.connections if self._proxy is not None else 0)

    @property
    def cuts(self) -> int:
        """Connections that it has reset."""
        return self._cuts + (self._proxy.cuts if self._proxy is not None else 0)

    def change(self, weather: Weather) -> None:
        """From now on."""
        self._weather = weather
        if self._proxy is not None:
            self._proxy.weather = weather

    def _watch(self) -> None:
        while not self._over.wait(LOOK_SECONDS):
            with suppress(OSError):  # its folder goes, amid it
                path = self._place()
                if path is not None and path.stat().st_ino != self._ours:
                    self._slip_in(path)

    def _slip_in(self, path: Path) -> None:
        behind, ours = path.with_suffix(".behind"), path.with_suffix(".ours")
        ours.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(str(ours))
        listener.listen()
        path.rename(behind)
        ours.rename(path)
        self._end_proxy()
        self._ours, self._proxy = path.stat().st_ino, Proxy(listener, lambda: behind)
        self._proxy.weather = self._weather
        self.placed += 1

    def _end_proxy(self) -> None:
        if self._proxy is not None:
            self._proxy.close()
            self._connections, self._cuts = self.connections, self.cuts
            self._proxy = None

    def close(self) -> None:
        """End it; what it counted stays."""
        self._over.set()
        self._thread.join()
        self._end_proxy()
