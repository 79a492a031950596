"""The HTTP routes: the page's files, session, WebSocket and uploads, and ``/metrics``."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import msgspec
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from shmio.audit import trail
from shmio.endpoints.turns import Turns
from shmio.endpoints.web.measurements import Measurements
from shmio.endpoints.web.metrics import Exposition, InstanceCollector
from shmio.endpoints.web.page import Page, Tab
from shmio.endpoints.web.served import Served
from shmio.endpoints.web.sessions import COOKIE, MAX_AGE_S, Sessions, User
from shmio.endpoints.web.uploads import MAX_BYTES, Uploads
from shmio.endpoints.wrong_tokens import WrongTokens
from shmio.errors import EndpointError, ShmioError
from shmio.segment import Segment

STATIC: Final = Path(__file__).parent / "static"
MAX_PAGES: Final = 64
"""Maximum number of open pages that have made a call. Clients share them."""
MAX_SILENT: Final = 256
"""Maximum number of WebSockets on which no call has been made. If there are more, the oldest is closed."""
MAX_LOGIN_BYTES: Final = 4096
_TYPES: Final = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_POLICY: Final = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "cache-control": "no-cache",
}
_HINT: Final = "shmio: /metrics has the figures of the instance, for Prometheus\n"


def metrics_app(
    segment: Segment,
    measurements: Measurements,
    folders: Mapping[str, str],
    registers: Sequence[str],
    sessions: Sessions,
) -> Starlette:
    """Return the application of ``[metrics]``. It serves ``/metrics``, and a hint at ``/``.

    Args:
        segment: The instance's segment.
        measurements: Histograms of the sources' timing.
        folders: Directories whose free space is reported, by purpose.
        registers: Patterns of the registers whose values are reported.
        sessions: The tokens of clients, and the roles of clients without one.

    """
    wrong = WrongTokens()

    async def refuse(request: Request) -> Response | None:
        return await _refused(request, sessions, wrong, sessions.user(None, _host(request)))

    async def hint(_request: Request) -> Response:
        return PlainTextResponse(_HINT)

    return Starlette(routes=[_metrics(segment, measurements, folders, registers, refuse, Turns()), Route("/", hint)])


def _metrics(
    segment: Segment,
    measurements: Measurements,
    folders: Mapping[str, str],
    registers: Sequence[str],
    refuse: Callable[[Request], Awaitable[Response | None]],
    turns: Turns,
) -> Route:
    exposition = Exposition(InstanceCollector(segment, measurements, folders, registers))

    async def metrics(request: Request) -> Response:
        if (refused := await refuse(request)) is not None:
            return refused
        async with turns.of(request.headers.get("authorization") or _host(request)):
            return Response(await run_in_threadpool(exposition.answer), media_type=CONTENT_TYPE_LATEST)

    return Route("/metrics", metrics)


async def _refused(request: Request, sessions: Sessions, wrong: WrongTokens, user: User) -> Response | None:
    """Return the refusal of a client that may not read the metrics; None: the token, or else ``user``, allows it."""
    kind, _, token = request.headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        owner = sessions.owner(token, user.host)
        if owner is None and sessions.takes_tokens:
            _record_sign_in(user.host, "wrong token")
            if "read" not in user.roles:
                await wrong.slow_down(user.host)
        user = owner or user
    if "read" in user.roles:
        return None
    text = "this needs the role read; send Authorization: Bearer TOKEN, with a token of token_file or [[grpc.token]]\n"
    return PlainTextResponse(text, 401, {"www-authenticate": "Bearer"})


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class PageApp:
    """The application of ``[web]``: the page, its session and its WebSocket, and ``/metrics``."""

    def __init__(self, served: Served, sessions: Sessions, tabs: Sequence[type[Tab]], *, secure: bool) -> None:
        """Create the application.

        Args:
            served: What the pages show.
            sessions: The sessions of all users.
            tabs: The tabs of a page.
            secure: Whether the server uses TLS. Then browsers send the session's cookie over TLS only.

        """
        self._served, self._sessions, self._secure = served, sessions, secure
        self._tabs = [tab for tab in tabs if tab.offered(served)]
        self._cookie = COOKIE.format(served.segment.instance)
        self._pages: dict[Page, None] = {}
        """The pages that have made a call, the oldest first."""
        self._silent: dict[Page, None] = {}
        """The pages without a call, the oldest first."""
        self._uploads = Uploads()
        self._wrong = WrongTokens()
        self._files = {
            f"/{file.relative_to(STATIC)}": (file.read_bytes(), _TYPES[file.suffix])
            for file in STATIC.rglob("*")
            if file.suffix in _TYPES
        }
        self._files["/"] = self._files["/index.html"]

    @property
    def counters(self) -> tuple[int, int, int]:
        """Number of open pages, and numbers of messages and bytes that were sent to pages."""
        return len(self._pages), self._served.messages, self._served.bytes

    def app(self, measurements: Measurements, registers: Sequence[str]) -> Starlette:
        """Return the application, with its routes.

        Args:
            measurements: The histograms for ``/metrics``.
            registers: Patterns of the registers whose values ``/metrics`` reports.

        """
        routes: list[BaseRoute] = [
            _metrics(
                self._served.segment,
                measurements,
                self._served.folders,
                registers,
                self._refuse_metrics,
                self._served.turns,
            ),
            Route("/session", self._session, methods=["GET", "POST", "DELETE"]),
            Route("/layout", self._layout, methods=["POST"]),
            WebSocketRoute("/socket", self._socket),
            Route("/{path:path}", self._file),
        ]
        return Starlette(routes=routes)

    async def _file(self, request: Request) -> Response:
        found = self._files.get(request.url.path)
        if found is None:
            return PlainTextResponse("there is no such page\n", 404)
        return Response(found[0], media_type=found[1], headers=_POLICY)

    def _user(self, request: HTTPConnection) -> User:
        return self._sessions.user(request.cookies.get(self._cookie), _host(request))

    async def _refuse_metrics(self, request: Request) -> Response | None:
        return await _refused(request, self._sessions, self._wrong, self._user(request))

    async def _session(self, request: Request) -> Response:
        """Describe the user. POST first opens a session for a token, and DELETE first closes the session."""
        host = _host(request)
        if request.method == "GET":
            return JSONResponse(self._describe(self._user(request)))
        if request.method == "DELETE":
            self._sessions.close(request.cookies.get(self._cookie, ""))
            answer = JSONResponse(self._describe(self._sessions.user(None, host)))
            answer.delete_cookie(self._cookie, httponly=True, samesite="strict", secure=self._secure)
            return answer
        body = await _body(request, MAX_LOGIN_BYTES)
        if body is None:
            return JSONResponse({"error": "this text is too long for a token"}, 413)
        try:
            token = msgspec.json.decode(body, type=_Login).token
        except (msgspec.MsgspecError, UnicodeDecodeError):
            return JSONResponse({"error": "expected a JSON object with the key token"}, 400)
        opened = self._sessions.open(token, host)
        if opened is None:
            _record_sign_in(host, "wrong token")
            await self._wrong.slow_down(host)
            return JSONResponse({"error": "this token is not in [[grpc.token]]"}, 403)
        cookie, user = opened
        self._sessions.close(request.cookies.get(self._cookie, ""))
        trail.record("sign in", {}, "done", who=trail.Acting(user.actor, "web"))
        answer = JSONResponse(self._describe(user))
        answer.set_cookie(
            self._cookie, cookie, max_age=MAX_AGE_S, httponly=True, samesite="strict", secure=self._secure, path="/"
        )
        return answer

    async def _layout(self, request: Request) -> Response:
        """Return the registers in files that the user has dropped on the page. The files are not stored."""
        user = self._user(request)
        if "read" not in user.roles:
            return JSONResponse({"error": "this needs the role read; sign in"}, 403)
        try:
            body = await self._uploads.receive(request.stream())
            if body is None:
                return JSONResponse({"error": f"these files have more than {MAX_BYTES >> 20} MB"}, 413)
            return Response(
                await _while_connected(request, self._uploads.compile(body, user.client)), media_type="application/json"
            )
        except ClientDisconnect:
            return Response(status_code=400)  # nobody reads it
        except EndpointError as error:
            return JSONResponse({"error": str(error)}, 429)
        except ShmioError as error:
            return JSONResponse({"error": str(error)}, 422)

    def _describe(self, user: User) -> dict[str, object]:
        return {
            "instance": self._served.segment.instance,
            "name": user.name,
            "roles": user.listed_roles,
            "takes_tokens": self._sessions.takes_tokens,
            "tabs": [tab.name for tab in self._tabs],
        }

    async def _socket(self, socket: WebSocket) -> None:
        user = self._user(socket)
        if "read" not in user.roles:
            trail.record("read", {}, "denied", "it needs the role read", who=trail.Acting(user.actor, "web"))
            await socket.close(1008)  # before accept(): the client gets the status 403
            return
        page = Page(self._served, socket, user, self._tabs)
        cookie, host = socket.cookies.get(self._cookie), _host(socket)
        forget = self._sessions.on_end(cookie, host, lambda: page.end("the session has ended"))
        self._silent[page] = None
        if len(self._silent) > MAX_SILENT:
            oldest = next(iter(self._silent))
            oldest.end("the page made no call, and there are too many such pages")
            del self._silent[oldest]
        try:
            await page.run(lambda: self._admit(page), self._sessions.left_s(cookie, host))
        finally:
            forget()
            self._silent.pop(page, None)
            self._pages.pop(page, None)

    def _admit(self, page: Page) -> str:
        """Count a page that makes its first call. Return the reason to close it; empty: it stays open.

        No client keeps others out: if too many pages are open, the oldest of the client with most of them ends.
        """
        self._silent.pop(page, None)
        if len(self._pages) >= MAX_PAGES:
            counts = Counter(one.user.client for one in self._pages)
            most, count = counts.most_common(1)[0]
            if count <= counts[page.user.client] + 1:
                return f"{MAX_PAGES} pages are open; close one of them"
            oldest = next(one for one in self._pages if one.user.client == most)
            oldest.end(f"{MAX_PAGES} pages are open, and this client has most of them; another client needs one")
            del self._pages[oldest]
        self._pages[page] = None
        return ""


def _record_sign_in(host: str, reason: str) -> None:
    trail.record("sign in", {}, "denied", reason, who=trail.Acting(trail.Actor("anonymous", "", host), "web"))


async def _body(request: Request, most_bytes: int) -> bytes | None:
    """Return the body of a request; None if the body is too large, or the client disconnects too early."""
    body = bytearray()
    with suppress(ClientDisconnect):
        async for part in request.stream():
            body += part
            if len(body) > most_bytes:
                return None
        return bytes(body)
    return None


async def _while_connected(request: Request, work: Coroutine[Any, Any, bytes]) -> bytes:
    """Return the result of work for a request whose body was received. Cancel the work if the client leaves.

    Raises:
        ClientDisconnect: The client has left.
    """
    tasks = (asyncio.ensure_future(work), asyncio.ensure_future(request.receive()))  # next comes only a disconnect
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        if not tasks[0].done():
            raise ClientDisconnect
        return tasks[0].result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _host(request: HTTPConnection) -> str:
    return request.client.host if request.client else ""
