"""The server of ``rmc watch``: one page, its events and its pictures; reads, and only what the page shows."""

import asyncio
import json
import secrets
import socket
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from importlib.resources import files
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from rmc.analysis.live_run import LiveRun

LOOK_SECONDS = 0.5  # between looks at the runs
PING_SECONDS = 15.0  # without news, after which a page is told that we are there
PING = b"event: ping\ndata: -\n\n"
BACKLOG = 64  # looks that a page may be behind; beyond, it is told everything again
END_SECONDS = 1  # that a page has to take what it asked for, once we end
LOOPBACK = ["127.0.0.1", "localhost", "[::1]"]  # no other name: it could be a web page's that leads here
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' data:; media-src 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the token is in the address
    "Cache-Control": "no-store",
}


class EventStream:
    """What is new of the runs, to every open page. Each look is read and encoded once, however many there are."""

    def __init__(self, runs: Sequence[LiveRun]) -> None:
        self._runs, self._is_over = runs, False
        self._looks: deque[bytes] = deque(maxlen=BACKLOG)
        self._count = 0  # looks that found something
        self._next = asyncio.Event()

    async def follow(self, is_over: Callable[[], bool]) -> None:
        """Look at the runs until that says so; then every stream ends."""
        while not is_over():
            news = []
            for i, run in enumerate(self._runs):
                if (new := run.look()) is not None:
                    news.append(_event(i, new))
                await asyncio.sleep(0)  # pages are answered between runs
            if found := b"".join(news):
                self._looks.append(found)
                self._count += 1
                self._wake()
            await asyncio.sleep(LOOK_SECONDS)
        self._is_over = True
        self._wake()

    def _wake(self) -> None:
        self._next.set()
        self._next = asyncio.Event()

    async def stream(self) -> AsyncIterator[bytes]:
        """The events of one page: everything, then what is new."""
        told = self._count
        yield self._everything()
        while not self._is_over:
            if told == self._count and not await self._news():
                yield PING
            missed, told = self._count - told, self._count
            if missed > len(self._looks):
                yield self._everything()
            elif missed:
                yield b"".join(list(self._looks)[-missed:])

    async def _news(self) -> bool:
        """Whether there are some before a ping is due."""
        with suppress(TimeoutError):
            return await asyncio.wait_for(self._next.wait(), PING_SECONDS)
        return False

    def _everything(self) -> bytes:
        return b"".join(_event(i, {**run.everything(), "whole": True}) for i, run in enumerate(self._runs))


def _event(run: int, message: dict[str, Any]) -> bytes:
    return f"data: {json.dumps({'run': run, **message}, separators=(',', ':'))}\n\n".encode()


class TokenGuard:
    """Refuses every request without the token."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app, self._token = app, token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or pass the request on."""
        given = Request(scope).query_params.get("token", "")
        if secrets.compare_digest(given.encode(), self._token):
            await self._app(scope, receive, send)
        else:
            await PlainTextResponse("open the address that rmc watch has printed\n", 401)(scope, receive, send)


def application(runs: Sequence[LiveRun], broadcast: EventStream, host: str, token: str) -> Starlette:
    """The page of these runs, at ``host``; without a ``token`` for browsers of this machine alone."""
    page = files("rmc.analysis").joinpath("watch.html").read_text(encoding="utf-8")
    by_place = {str(place): run for place, run in enumerate(runs)}

    async def show(_: Request) -> Response:
        return HTMLResponse(page)

    async def stream(_: Request) -> Response:
        return StreamingResponse(broadcast.stream(), media_type="text/event-stream")

    async def media(request: Request) -> Response:
        run, kind = by_place.get(request.path_params["run"]), request.path_params["kind"]
        path = run.media.get(kind) if run is not None else None
        if path is None or not path.is_file():
            raise HTTPException(404)
        return FileResponse(path)

    guard = Middleware(TokenGuard, token) if token else Middleware(TrustedHostMiddleware, [*LOOPBACK, host])
    routes = [Route("/", show), Route("/events", stream), Route("/media/{run}/{kind}", media)]
    return Starlette(routes=routes, middleware=[guard])


def serve(runs: Sequence[LiveRun], listener: socket.socket, host: str, token: str) -> None:
    """Serve the page on a socket until Ctrl-C, which is a KeyboardInterrupt.

    By h11, which reads no more than 64 KiB of a request's headers; what strangers send wrongly is not shown.
    """

    async def run() -> None:
        broadcast = EventStream(runs)
        config = uvicorn.Config(
            application(runs, broadcast, host, token), lifespan="off", ws="none", log_config=None, access_log=False,
            proxy_headers=False, server_header=False, headers=list(HEADERS.items()), http="h11", log_level="critical",
            timeout_graceful_shutdown=END_SECONDS,
        )  # fmt: skip
        server = uvicorn.Server(config)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(broadcast.follow(lambda: server.should_exit))
            await server.serve(sockets=[listener])

    asyncio.run(run())
