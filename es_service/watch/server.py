"""The server of the live page: its addresses, what answers each of them, and who may see it.

Reading and drawing are done in threads, a replay by a child process of one more; one replay at a time.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlencode, urlsplit

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import (
    HTMLResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from es_service.errors import ConfigError, ServiceError
from es_service.report.data import RunData
from es_service.report.maps import path_lines
from es_service.report.page import EvaluateText, asset
from es_service.report.replays import replay_section
from es_service.runs.replay import CERTIFIED
from es_service.runs.view import open_run
from es_service.watch import pages
from es_service.watch.channels import Allowance, PageChannel, Picture
from es_service.watch.pages import metrics
from es_service.watch.runs import FoundRun, RunReading, Runs, require_inside

# Who may see the live page: only this machine, or whoever has the token.
#
# Without a token, the server listens on the loopback interface only, and answers requests for a name of this machine
# only: otherwise a page of the internet could give its own name this address, and read the answers (DNS rebinding).

LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
COOKIE = "es-service-watch"
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Guard:
    """ASGI middleware that refuses strangers, and adds headers that restrict what a page may do."""

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        """`token`: what a viewer must know; None: requests must be for a name of this machine."""
        self._app, self._token = app, token
        # Several pages may be served on one host, and browsers keep the same cookies for all of its ports.
        self._cookie = f"{COOKIE}-{hashlib.sha256((token or '').encode()).hexdigest()[:8]}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        answer = self._refusal(Request(scope)) if scope["type"] == "http" else None
        await (answer or self._app)(scope, receive, with_headers)

    def _refusal(self, request: Request) -> Response | None:
        """What answers a request in the place of the page; None if the page does."""
        if self._token is None and _host(request) not in LOCAL:
            return PlainTextResponse("this page is only for names of this machine, such as localhost\n", 403)
        if request.method not in ("GET", "HEAD") and _is_from_elsewhere(request):
            return PlainTextResponse("this request comes from another page\n", 403)
        if self._token is None:
            return None
        given = request.query_params.get("token")
        if given is not None and self._is_token(given):
            rest = urlencode([pair for pair in request.query_params.multi_items() if pair[0] != "token"])
            answer = RedirectResponse(request.url.path + (f"?{rest}" if rest else ""), 303)
            answer.set_cookie(self._cookie, self._token, httponly=True, samesite="strict")
            return answer
        bearer = request.headers.get("authorization", "").removeprefix("Bearer ")
        if self._is_token(request.cookies.get(self._cookie, "")) or self._is_token(bearer):
            return None
        told = "open the address with the token that `es-service watch` has printed\n"
        return PlainTextResponse(told, 401, {"WWW-Authenticate": "Bearer"})

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(errors="replace"), (self._token or "").encode())


def _host(request: Request) -> str:
    try:
        return urlsplit(f"//{request.headers.get('host', '')}").hostname or ""
    except ValueError:
        return ""


def _is_from_elsewhere(request: Request) -> bool:
    """Whether a browser says that a page of another origin has sent the request."""
    origin = request.headers.get("origin")
    try:
        other = origin is not None and urlsplit(origin).netloc != request.headers.get("host")
    except ValueError:  # it is no address
        other = True
    return other or request.headers.get("sec-fetch-site", "same-origin") != "same-origin"


ASSETS = {
    "page.css": ("es_service.report", "text/css"),
    "page.js": ("es_service.report", "text/javascript"),
    "replay.js": ("es_service.report", "text/javascript"),
    "three.bundle.js": ("es_service.report", "text/javascript"),
    "live.css": ("es_service.watch", "text/css"),
    "live.js": ("es_service.watch", "text/javascript"),
}
EVENTS = "text/event-stream"
MOST_COMPARED = 50
MOST_DIGITS = 12
"""Digits of the number of a cell."""
MOST_REPLAYS = 16
"""Replays that are kept for the next viewer."""
_READING = ThreadPoolExecutor(4, "reading")
_RECORDING = ThreadPoolExecutor(1, "recording")
T = TypeVar("T")


class Site:
    """The live page of the runs below some folders."""

    def __init__(self, roots: Sequence[Path], evaluate: Callable[[Path], EvaluateText], *, trusted: bool) -> None:
        """`evaluate`: what evaluates a policy of a run's folder, as text. `trusted`: see `replay_section`."""
        self._runs, self._evaluate, self._trusted = Runs(roots), evaluate, trusted
        self._channels: dict[str, PageChannel] = {}
        self._allowance, self._recording = Allowance(), asyncio.Lock()
        self._readings: dict[str, RunReading] = {}
        self._replays: dict[tuple[Any, ...], dict[str, Any]] = {}

    def app(self, token: str | None) -> Starlette:
        routes = [
            Route("/", self._list),
            Route("/run/{key}", self._run),
            Route("/run/{key}/cell/{cell}", self._cell),
            Route("/run/{key}/replay/{which}", self._replay, methods=["POST"]),
            Route("/compare", self._compare),
            Route("/events/{page:path}", self._events),
            Route("/metrics", self._metrics),
            Route("/assets/{name}", self._asset),
        ]
        return Starlette(routes=routes, middleware=[Middleware(Guard, token=token)])

    async def _list(self, request: Request) -> Response:
        return HTMLResponse(pages.shell("Runs", "/events/list"))

    async def _run(self, request: Request) -> Response:
        run = await self._found(request.path_params["key"])
        return HTMLResponse(pages.shell(run.name, f"/events/run/{run.key}", f"/run/{run.key}"))

    async def _compare(self, request: Request) -> Response:
        return HTMLResponse(pages.shell("Comparison", f"/events/compare?{request.url.query}"))

    async def _metrics(self, request: Request) -> Response:
        text = await _in(_READING, lambda: metrics(self._runs.summaries()))
        return PlainTextResponse(text, media_type="text/plain; version=0.0.4")

    async def _asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            raise HTTPException(404)
        package, kind = ASSETS[name]
        return Response(asset(name, package), media_type=kind)

    async def _events(self, request: Request) -> Response:
        if request.method == "HEAD":  # the stream would not end
            await self._drawer(request)
            return Response(media_type=EVENTS)
        name = request.path_params["page"]
        if name == "compare":
            name += f"?{request.url.query}"
        if name not in self._channels:
            draw, reading = await self._drawer(request)
            if name not in self._channels:  # it may have been made meanwhile
                self._channels[name] = PageChannel(draw, lambda: self._ended(name), self._allowance)
                if reading is not None:
                    self._readings[name] = reading
        return StreamingResponse(self._channels[name].stream(), media_type=EVENTS)

    def _ended(self, name: str) -> None:
        del self._channels[name]
        self._readings.pop(name, None)

    async def _drawer(self, request: Request) -> tuple[Callable[[], Picture | None], RunReading | None]:
        """What draws a page, and for the page of one run what reads it."""
        match request.path_params["page"].split("/"):
            case ["list"]:
                return pages.draw_list(self._runs), None
            case ["run", key]:
                run = await self._found(key)
                reading = RunReading(run)
                return pages.draw_run(self._runs, run, reading), reading
            case ["compare"]:
                keys = list(dict.fromkeys(request.query_params.getlist("run")))
                found = [await self._found(key) for key in keys[:MOST_COMPARED]]
                group_by, compared = request.query_params.getlist("group_by"), [(run, RunReading(run)) for run in found]
                return pages.draw_comparison(compared, group_by, left_out=len(keys) - len(found)), None
        raise HTTPException(404)

    async def _found(self, key: str) -> FoundRun:
        run = await _in(_READING, lambda: self._runs.get(key))
        if run is None:
            raise HTTPException(404, "there is no such run below the folders that are watched")
        return run

    async def _cell(self, request: Request) -> Response:
        """The path of an elite, and the call that evaluates it."""
        run, cell = await self._found(request.path_params["key"]), _cell(request.path_params["cell"])
        return _json(await _answer(_READING, lambda: self._details(run, cell)))

    def _details(self, run: FoundRun, cell: int) -> dict[str, Any]:
        data = self._data(run)
        if data.map is None or cell not in data.map.cell_N:
            raise HTTPException(404, "this cell is empty")
        try:
            _, elites = open_run(run.folder).elites(lambda snapshot: [cell])
            paths = {cell: elite.trace_T_B for cell, elite in elites.items()}
        except (ServiceError, KeyError):  # it is damaged, or empty now, which the page says
            paths = {}
        path = path_lines(replace(data, paths=paths))
        return path | {"evaluate": self._evaluate(run.folder)(data.cell_name(cell))}

    async def _replay(self, request: Request) -> Response:
        run, which = await self._found(request.path_params["key"]), request.path_params["which"]
        async with self._recording:
            if await request.is_disconnected():  # the viewer has chosen another cell meanwhile
                return Response(status_code=409)
            return _json(await _answer(_RECORDING, lambda: self._recorded(run, which)))

    def _recorded(self, run: FoundRun, which: str) -> dict[str, Any]:
        """The section of a replay, of "best", "certified" or the elite of a cell, and what its script needs."""
        data = self._data(run)
        named = {"best": data.best, CERTIFIED: data.certified and data.certified.number}
        cells = [] if which in named else [_place(data, which)]
        since = named[which] if which in named else _generation(data, int(which))
        name = (run.key, data.meta.run_id, which, since)
        if name not in self._replays:
            best, certified = which == "best", which == CERTIFIED
            section = replay_section(data, best=best, cells=cells, certified=certified, trusted=self._trusted)
            while len(self._replays) >= MOST_REPLAYS:
                del self._replays[next(iter(self._replays))]
            self._replays[name] = {"html": section["section"], "data": section["scripts"]}
        return self._replays[name]

    def _data(self, run: FoundRun) -> RunData:
        """The run as an open page shows it, else as it is."""
        require_inside(run)
        reading = self._readings.get(f"run/{run.key}") or RunReading(run)
        if reading.data is None:
            reading.update()
        assert reading.data is not None
        return reading.data


def _place(data: RunData, cell: str) -> tuple[int, ...]:
    number = _cell(cell)
    if data.map is None or number not in data.map.cell_N:
        raise HTTPException(404, "this cell is empty")
    return tuple(map(int, data.map.geometry.index_of(number)))


def _cell(text: str) -> int:
    """The number of a cell. Raises HTTPException if it cannot be one."""
    if not text.isdecimal() or len(text) > MOST_DIGITS:
        raise HTTPException(404, "there is no such cell")
    return int(text)


def _generation(data: RunData, cell: int) -> int:
    assert data.map is not None
    return int(data.map.generation_N[data.map.row_of(cell)])


def _json(value: Mapping[str, Any]) -> Response:
    """In ASCII, since the path of a run may be no UTF-8."""
    return Response(json.dumps(value, allow_nan=False), media_type="application/json")


async def _in(threads: ThreadPoolExecutor, work: Callable[[], T]) -> T:
    return await asyncio.get_running_loop().run_in_executor(threads, work)


async def _answer(threads: ThreadPoolExecutor, work: Callable[[], T]) -> T:
    try:
        return await _in(threads, work)
    except ServiceError as error:
        raise HTTPException(409, error.sentence.encode(errors="replace").decode()) from error


def serve(
    roots: Sequence[Path],
    evaluate: Callable[[Path], EvaluateText],
    on_start: Callable[[str], None],
    *,
    host: str,
    port: int,
    trusted: bool,
) -> None:
    """Serve the live page until a signal arrives.

    Args:
        on_start: called with the address of the page, which contains the token if one is needed.
        host: address to listen on; viewers need a token unless it is that of the loopback interface.
        port: 0 for a free one.

    Raises:
        ConfigError: it cannot listen there.
    """
    token = None if host in LOCAL else secrets.token_urlsafe(32)
    try:
        listener = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        what = f"cannot listen on {host}, port {port}: {error.strerror or error}; choose another port, or 0 for any"
        raise ConfigError(what, field="port", value=port) from error
    config = uvicorn.Config(
        Site(roots, evaluate, trusted=trusted).app(token),
        log_config=None, log_level="critical", access_log=False, server_header=False, proxy_headers=False,
        lifespan="off", ws="none", timeout_graceful_shutdown=1,
    )  # fmt: skip
    shown = f"[{host}]" if ":" in host else socket.gethostname() if host in ("0.0.0.0", "::") else host
    address = f"http://{shown}:{listener.getsockname()[1]}/"
    on_start(address if token is None else f"{address}?token={token}")
    uvicorn.Server(config).run(sockets=[listener])
