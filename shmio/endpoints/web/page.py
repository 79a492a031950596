"""One open page: its WebSocket, the calls that it makes, and the data that it follows.

A page sends calls as JSON text, ``{"id": 7, "call": "registers.rows", "with": {…}}``. The answer is
``{"id": 7, "result": …}`` or ``{"id": 7, "error": "…"}``. The server sends data that a page follows
as ``{"topic": "overview", "data": …}``, or as binary messages for plots (``signals.py``). The
classes in ``tabs/`` implement the calls.

Nothing waits for a slow page: newer data replaces data of the same topic that has not been sent
yet.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping
from contextlib import nullcontext, suppress
from typing import Any, ClassVar, Final, NamedTuple, TypeVar

import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect

from shmio.audit.trail import Attempt, act, acting
from shmio.endpoints.web.served import Served
from shmio.endpoints.web.sessions import User
from shmio.errors import ShmioError
from shmio.model.cell import Closable

MAX_CALLS: Final = 16
"""Maximum number of a page's calls that may be in progress. Further calls wait."""
MAX_BATCHES: Final = 32
"""Maximum number of binary messages that wait for a page. If there are more, the oldest are dropped."""
FOLLOW_S: Final = 0.02
"""Least time in s between two requests of a page to follow a tab, because each one causes data to be sent at once."""
CLOSE_S: Final = 1.0
"""Time in s for which a page that is being closed waits for its client to read the reason."""
FIRST_CALL_S: Final = 10.0
"""Time in s that a page has to make its first call. If too many pages have made none, the oldest is closed."""

_log = logging.getLogger("shmio.web")


class Nothing(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of a call that takes no arguments."""


class _Message(msgspec.Struct, forbid_unknown_fields=True):
    """A call as a page sends it."""

    id: int
    call: str
    arguments: msgspec.Raw = msgspec.field(name="with", default=msgspec.Raw(b"{}"))


class Call(NamedTuple):
    """A call that pages can make: the role that it needs, the type of its arguments, and its function."""

    role: str
    arguments: type[msgspec.Struct]
    function: Callable[[Any, Any], Coroutine[Any, Any, Any]]


_Arguments = TypeVar("_Arguments", bound=msgspec.Struct)
_Tab = TypeVar("_Tab", bound="Tab")


def call(
    role: str, arguments: type[_Arguments]
) -> Callable[[Callable[[_Tab, _Arguments], Awaitable[Any]]], Callable[[_Tab, _Arguments], Awaitable[Any]]]:
    """Return a decorator for a method of a tab, which pages can then call as ``<tab>.<method>``.

    Args:
        role: The role that a user needs.
        arguments: The type of the arguments.

    """

    def mark(
        method: Callable[[_Tab, _Arguments], Awaitable[Any]],
    ) -> Callable[[_Tab, _Arguments], Awaitable[Any]]:
        method.page_call = (role, arguments)  # type: ignore[attr-defined]
        return method

    return mark


def release(resources: Mapping[str, Closable], user: User) -> None:
    """Close the resources of a closed page. Those that another program or a source has ended are skipped.

    Args:
        resources: The resources, by name.
        user: The user of the page, for the audit log.
    """
    for name, one in resources.items():
        with acting(user.actor, "web"), suppress(ShmioError), Attempt("lift", {name: None}) as attempt:
            one.close()
            attempt.end("done", "the page was closed")


class Tab:
    """A tab of a page: the state that it has on the server, and its calls."""

    name: ClassVar[str]
    calls: ClassVar[Mapping[str, Call]]
    takes_turns: ClassVar[bool] = True
    """Whether the calls that only read wait for the client's turn. It is false if their work has another limit."""

    def __init_subclass__(cls) -> None:
        """Collect the calls of the class."""
        cls.calls = {
            f"{cls.name}.{name}": Call(method.page_call[0], method.page_call[1], method)
            for name, method in inspect.getmembers(cls, lambda member: hasattr(member, "page_call"))
        }

    def __init__(self, page: Page) -> None:
        self.page = page

    @classmethod
    def offered(cls, served: Served) -> bool:  # noqa: ARG003  subclasses use it
        """Return whether pages of this instance have this tab."""
        return True

    def close(self) -> None:
        """Release the tab's resources. This is called when the page is closed."""


class FollowedTab(Tab):
    """A tab that sends its data whenever it changes, while the page shows the tab."""

    name: ClassVar[str] = ""

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._following: asyncio.Task[None] | None = None
        self._followed_s = 0.0

    @call("read", Nothing)
    async def follow(self, _: Nothing) -> None:
        """Send the tab's data now, and again whenever it changes, until :meth:`leave`."""
        await self.leave(_)
        now_s = asyncio.get_running_loop().time()
        await asyncio.sleep(self._followed_s + FOLLOW_S - now_s)  # returns at once if the time is over
        self._followed_s = asyncio.get_running_loop().time()
        self._following = self.page.start(self._follow())

    @call("read", Nothing)
    async def leave(self, _: Nothing) -> None:
        """End :meth:`follow`: send no more data."""
        if self._following is not None:
            self._following.cancel()
            self._following = None

    async def _follow(self) -> None:
        """Send the tab's data whenever it changes."""
        raise NotImplementedError


_ACTIONS: Final = {
    "registers.set": "write",
    "registers.override": "inject",
    "injections.start": "declare",
    "injections.lift_all": "lift",
}
"""The action of a call in the audit log, where it differs from the name of the method."""


def _outcome(result: Any) -> tuple[str, str]:
    """Return the outcome and its reason from the result of a call."""
    if isinstance(result, dict) and "outcome" in result:
        return str(result["outcome"]), str(result.get("reason", ""))
    return "done", ""


class Page:
    """One open page. Use it in the event loop's thread only."""

    def __init__(self, served: Served, socket: WebSocket, user: User, tabs: Iterable[type[Tab]]) -> None:
        self.served = served
        self.user = user
        self.host: str = socket.headers["host"]
        """How the browser names this server: host and port."""
        self.turn = served.turns.of(user.client)
        """What the user's client has of the server's time."""
        self._socket = socket
        self._tabs = {tab.name: tab(self) for tab in tabs}
        self._calls = {name: (call, tab) for tab in self._tabs.values() for name, call in tab.calls.items()}
        self._tasks: set[asyncio.Task[Any]] = set()
        self._room = asyncio.Semaphore(MAX_CALLS)
        self._answers: deque[bytes] = deque()  # bounded: a call counts as in progress until its answer is sent
        self._newest: dict[str, bytes] = {}
        self._batches: deque[bytes] = deque(maxlen=MAX_BATCHES)
        self._waiting = asyncio.Event()
        self.silent = True
        """True until the page makes its first call."""
        self._limit = asyncio.timeout(FIRST_CALL_S)
        self._why = "the page made no call in time"

    async def run(self, admit: Callable[[], str], lasts_s: float | None = None) -> None:
        """Serve the page until it is closed.

        Args:
            admit: Called at the page's first call. It returns why to close the page; empty if the
                page may stay open.
            lasts_s: Time in s after which the user's session ends; None if it does not end.

        """
        sender = self._start(self._send())
        try:
            async with self._limit:
                await self._socket.accept()
                sender.add_done_callback(lambda _: self.end("the connection is lost"))
                message = await self._receive()
                if message is not None and self.silent:
                    self.silent = False
                    if refusal := admit():
                        self.end(refusal)
                    else:
                        self._why = "the session has ended"
                        self._limit.reschedule(None if lasts_s is None else asyncio.get_running_loop().time() + lasts_s)
                await self._serve(message)
        except TimeoutError:
            with suppress(RuntimeError, TimeoutError):  # the connection is closed, or the client does not read
                async with asyncio.timeout(CLOSE_S):
                    await self._socket.close(1008, self._why)
        except (WebSocketDisconnect, RuntimeError):  # starlette raises RuntimeError for a connection that is closed
            pass
        finally:
            for tab in self._tabs.values():
                tab.close()
            tasks = [sender, *self._tasks]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def end(self, why: str) -> None:
        """Close the page. ``why`` is the reason that the page is told."""
        self.silent, self._why = False, why
        with suppress(RuntimeError):  # run() has ended, or has not started
            self._limit.reschedule(asyncio.get_running_loop().time())

    async def _serve(self, message: str | None) -> None:
        while message is not None:
            await self._room.acquire()
            self._start(self._answer(message))
            message = await self._receive()

    def start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run work in the background, in the client's turns. It is cancelled when the page is closed."""
        task = self._start(self.turn.run(work))
        task.add_done_callback(lambda _: work.close())  # the page may be closed before the work begins
        return task

    def _start(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def push(self, topic: str, data: object) -> None:
        """Send data of a topic soon. It replaces data of the same topic that has not been sent yet."""
        self._newest[topic] = msgspec.json.encode({"topic": topic, "data": data})
        self._waiting.set()

    def push_batch(self, batch: bytes) -> None:
        """Send a binary message soon. If too many are waiting, drop the oldest."""
        self._batches.append(batch)
        self._waiting.set()

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None and not isinstance(error, (WebSocketDisconnect, RuntimeError)):
            _log.error("a background task of an open page failed", exc_info=error)

    async def _receive(self) -> str | None:
        """Return the next message; None if the page is closed or sends anything but text."""
        message = await self._socket.receive()
        text: str | None = message.get("text") if message["type"] == "websocket.receive" else None
        return text

    def _attempt(self, message: _Message) -> Attempt:
        """Create a call's entry in the audit log."""
        tab, _, name = message.call.partition(".")
        attempt = Attempt(_ACTIONS.get(message.call, name.replace("_", " ")), {"tab": tab})
        arguments = msgspec.json.decode(message.arguments)
        if isinstance(arguments, dict):
            named = {str(arguments["path"]): arguments["value"]} if arguments.keys() == {"path", "value"} else arguments
            attempt.what = named
        return attempt

    async def _answer(self, text: str) -> None:
        """Carry out the call in a message, and send the answer."""
        act(self.user.actor, "web")  # in this task, and in those that it starts
        number = 0
        try:
            try:
                message = msgspec.json.decode(text, type=_Message)
                number = message.id
                made, tab = self._calls.get(message.call, (None, None))
                if made is None or tab is None:
                    raise ShmioError(f"unknown call {message.call[:80]!r}")
                attempt = None if made.role == "read" else self._attempt(message)
                if made.role not in self.user.roles:
                    denial = self._denial(made.role)
                    (attempt or self._attempt(message)).end("denied", denial)
                    raise ShmioError(denial)
                arguments = msgspec.json.decode(message.arguments, type=made.arguments)
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
                raise ShmioError(f"the call is malformed: {error}") from None
            in_turn = made.role == "read" and (tab.takes_turns or message.call.endswith(".follow"))
            async with self.turn if in_turn else nullcontext():
                with attempt or nullcontext():
                    work = made.function(tab, arguments)
                    result = await (self.turn.run(work) if made.role == "read" else work)
                    if attempt is not None:
                        attempt.end(*_outcome(result))
                answer = msgspec.json.encode({"id": number, "result": result})
        except ShmioError as error:
            answer = msgspec.json.encode({"id": number, "error": str(error)})
        except asyncio.CancelledError:
            raise
        except Exception as error:  # noqa: BLE001  the page gets an answer to each call
            # An error of the operating system, such as that no descriptor is free, is no error in the program.
            _log.error("a call of a page failed: %s", error, exc_info=not isinstance(error, OSError))
            text = "the server failed to do this; its log has the reason"
            answer = msgspec.json.encode({"id": number, "error": text})
        self._answers.append(answer)
        self._waiting.set()

    def _denial(self, role: str) -> str:
        who = f"the token {self.user.name!r}" if self.user.name else "without a token, this address"
        has = ", ".join(self.user.listed_roles) or "none"
        return f"this needs the role {role}; {who} has the roles: {has}"

    async def _send(self) -> None:
        """Send what waits: answers first, then the newest data."""
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await self._waiting.wait()
                self._waiting.clear()
                while self._answers:
                    text = self._sent(self._answers.popleft()).decode()
                    await self.turn.share.count(self._socket.send_text(text))  # the call has had its turn
                    self._room.release()
                while self._newest:
                    text = self._sent(self._newest.pop(next(iter(self._newest)))).decode()
                    await self.turn.run(self._socket.send_text(text))
                while self._batches and not self._answers:
                    await self.turn.run(self._socket.send_bytes(self._sent(self._batches.popleft())))

    def _sent(self, message: bytes) -> bytes:
        self.served.messages += 1
        self.served.bytes += len(message)
        return message
