"""Writes this process's entries to the audit log.

A module calls :func:`record`, or creates an :class:`Attempt` and ends it when the outcome is known.
Neither waits for the disk: a thread encodes the entries and writes them to the file. In a process
without an audit log, such as a test or a user's program, both do nothing.

A context variable holds the actor, so that functions need not pass the actor on. The code that
identifies a client sets the variable (:func:`acting`). New tasks and ``asyncio.to_thread`` inherit
it.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final, NamedTuple

import msgspec

from shmio.audit.file import AuditFile, AuditSettings
from shmio.errors import ShmioError
from shmio.times import utc_text

MAX_WAITING: Final = 10_000
"""Maximum number of entries that wait to be written. Further entries are discarded, and only counted."""
MAX_NAMED: Final = 32
"""Maximum number of values in an entry. Further values are left out, and only counted."""
MAX_ELEMENTS: Final = 16
"""Maximum number of elements that an entry shows of an array."""
MAX_TEXT: Final = 200
"""Maximum number of characters that an entry shows of a text."""
MAX_REASON: Final = 500
"""Maximum number of characters that an entry shows of a reason."""
MAX_BATCH: Final = 500
"""Maximum number of entries that are written in one go."""
MERGED: Final = frozenset({"feed", "read", "sign in", "step"})
"""Actions that a client can repeat many times a second. Repetitions within a second share one entry.

The same holds for all actions that are denied. A ``read`` is recorded only if it is denied.
"""
MERGE_S: Final = 1.0
MAX_MERGED: Final = 1000
"""Maximum number of different actions whose repetitions are being merged at the same time."""
RETRY_S: Final = 1.0
"""Pause in s before a failed write is retried."""
CLOSE_S: Final = 2.0
"""Maximum time in s for which a process waits at its end until the last entries are written."""

log = logging.getLogger("shmio.audit")


class Actor(NamedTuple):
    """Who acts, and from where.

    Attributes:
        kind: How the actor was identified: ``token``, ``certificate``, ``account``, ``uid``,
            ``host`` (a Sparkplug host application), ``process`` (of the instance), ``signal``, or
            ``anonymous``.
        name: Name of the token or account, first name in the certificate, or number of the user;
            empty if unknown.
        origin: Address of the client, or the program and its pid.

    """

    kind: str = "anonymous"
    name: str = ""
    origin: str = ""


@dataclass(slots=True)
class Acting:
    """An actor, and the endpoint through which the actor acts, for example during one call.

    ``refused`` is True once a refusal has been recorded, so that no other layer records it again.
    """

    actor: Actor
    endpoint: str
    refused: bool = False

    @property
    def text(self) -> str:
        """Who acts, and from where, in the words of ``shmio-supervisor audit``."""
        return words_of(self.endpoint, self.actor.kind, self.actor.name, self.actor.origin)


def words_of(endpoint: str, kind: str, name: str, origin: str) -> str:
    """Return who acts through an endpoint, as text for users."""
    who = f"{kind} {name}".rstrip()
    return f"{endpoint}: {who} ({origin})" if origin else f"{endpoint}: {who}"


_present: ContextVar[Acting | None] = ContextVar("acting", default=None)


def act(actor: Actor, endpoint: str) -> Acting:
    """Make ``actor`` the actor of this task or thread from now on. Return the new :class:`Acting`."""
    found = Acting(actor, endpoint)
    _present.set(found)
    return found


@contextmanager
def acting(actor: Actor, endpoint: str) -> Iterator[Acting]:
    """Make ``actor`` the actor of this task or thread within a ``with`` block."""
    found = Acting(actor, endpoint)
    before = _present.set(found)
    try:
        yield found
    finally:
        _present.reset(before)


def present() -> Acting | None:
    """Return the actor of this task or thread; None if no client is known."""
    return _present.get()


def uid_actor(uid: int | None, origin: str) -> Actor:
    """Return the actor for the user with this id on this host. If ``uid`` is None, the user is unknown."""
    return Actor("uid", "" if uid is None else str(uid), origin)


def program_of(pid: int) -> str:
    """Return the name of the program that a process runs; empty if the process has ended."""
    try:
        return Path(f"/proc/{pid}/comm").read_text(errors="replace").strip()
    except OSError:
        return ""


class Entry(msgspec.Struct):
    """A line of the audit log. docs/reference/audit.md describes the fields."""

    time: str
    instance: str
    process: str
    pid: int
    endpoint: str
    kind: str
    who: str
    origin: str = msgspec.field(name="from")
    action: str
    outcome: str
    reason: str
    what: Any
    left_out: int
    count: int
    command: int
    event: int


What = Mapping[str, Any] | Callable[[], Mapping[str, Any]]


class _Waiting(NamedTuple):
    time_s: float
    acting: Acting
    action: str
    what: What
    outcome: str
    reason: str
    command: int
    event: int
    times: int

    @property
    def kind(self) -> tuple[object, ...] | None:
        """Key that all repetitions of an action share; None if repetitions are not merged."""
        if (self.action not in MERGED and self.outcome != "denied") or callable(self.what):
            return None
        return self.acting.actor, self.acting.endpoint, self.action, self.outcome, self.reason, *self.what


class _Repeated:
    """Repetitions of an action that have no entry yet."""

    __slots__ = ("last", "times", "until_s")

    def __init__(self, until_s: float) -> None:
        self.until_s = until_s
        self.times = 0
        self.last: _Waiting | None = None


def record(
    action: str,
    what: What,
    outcome: str,
    reason: str = "",
    *,
    who: Acting | None = None,
    command: int = 0,
    event: int = 0,
    count: int = 1,
) -> None:
    """Add an entry to the audit log. This never waits for the disk, and never fails.

    Args:
        action: What was done or attempted, such as ``write``.
        what: What the action is about: values by path or by name, or a function that returns them.
            The thread that writes the log calls the function.
        outcome: The outcome, such as ``written`` or ``denied``.
        reason: The reason for the outcome; empty for a success.
        who: The actor; None for the actor of this task or thread, or else this process itself.
        command: Number of the command; 0 if there is none.
        event: Number of the source's event that ended the command; 0 if there is none, or it is not
            known.
        count: How many times this was done.

    """
    trail = _trail
    if trail is None:
        return
    who = who or _present.get() or Acting(Actor("process", trail.process), trail.process)
    trail.add(_Waiting(time.time(), who, action, what, outcome, reason, command, event, count))


class Attempt:
    """An action whose outcome is not known yet.

    In a ``with`` block, an exception ends the attempt. Without an exception, the attempt stays open
    after the block, because the outcome may come later.
    """

    __slots__ = ("_action", "_ended", "_who", "command", "event", "what")

    def __init__(self, action: str, what: What) -> None:
        """Start an attempt by the actor of this task or thread."""
        self._action = action
        self._who = _present.get()
        self._ended = False
        self.what = what
        """What the action is about; see :func:`record`."""
        self.command = 0
        """Number of the command; 0 if none was sent."""
        self.event = 0
        """Number of the source's event that ended the command; 0 if it is not known."""

    @contextmanager
    def acting(self) -> Iterator[None]:
        """Make the attempt's actor the actor of this task or thread within a ``with`` block."""
        before = _present.set(self._who)
        try:
            yield
        finally:
            _present.reset(before)

    def __enter__(self) -> Attempt:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if error is None:
            return
        expected = isinstance(error, ShmioError)
        reason = str(error) if expected else type(error).__name__
        self.end("refused" if expected else "cancelled", reason, refused=expected)

    def end(self, outcome: str, reason: str = "", *, refused: bool = False) -> None:
        """Record the outcome in the audit log. Only the first call has an effect.

        Args:
            outcome: The outcome.
            reason: The reason for the outcome; empty for a success.
            refused: Whether this entry records a refusal. Then no other layer records it again.

        """
        if self._ended:
            return
        self._ended = True
        if refused and self._who is not None:
            self._who.refused = True
        record(self._action, self.what, outcome, reason, who=self._who, command=self.command, event=self.event)


def values_of(source: str, values: Mapping[str, Any]) -> What:
    """Return a source's values in the form that :func:`record` expects: by path, including the source."""
    first = {f"{source}/{path}": _cut(value) for path, value in islice(values.items(), MAX_NAMED)}
    return _Cut(first, max(0, len(values) - MAX_NAMED))


def _brief(what: What) -> What:
    """Return ``what`` cut to the values that an entry has, so that the others need no memory."""
    if callable(what) or isinstance(what, _Cut):
        return what
    return _Cut({key: _cut(value) for key, value in islice(what.items(), MAX_NAMED)}, max(0, len(what) - MAX_NAMED))


class _Cut(dict[str, Any]):
    """The first values of a mapping; ``left_out`` is the number of the others."""

    def __init__(self, values: Mapping[str, Any], left_out: int) -> None:
        super().__init__(values)
        self.left_out = left_out


def _cut(value: Any, most: int = MAX_TEXT) -> Any:
    if isinstance(value, str):
        return value if len(value) <= most else value[:most] + "…"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # JSON has no such numbers
    if isinstance(value, (bool, int, float)) or value is None:
        return value
    if isinstance(value, (bytes, bytearray, memoryview)):
        return value[:MAX_TEXT].hex()
    if isinstance(value, Mapping):
        return {str(key): _cut(one) for key, one in islice(value.items(), MAX_ELEMENTS)}
    if hasattr(value, "__len__") and hasattr(value, "__getitem__"):  # a list, a tuple or an array
        first = [_cut(value[at]) for at in range(min(len(value), MAX_ELEMENTS))]
        return first if len(value) <= MAX_ELEMENTS else [*first, f"… {len(value) - MAX_ELEMENTS} more"]
    item = getattr(value, "item", None)  # a numpy number
    return _cut(str(value) if item is None else item())


class Trail:
    """Writes the entries of one process, in a thread of its own."""

    def __init__(self, settings: AuditSettings, instance: str, process: str) -> None:
        self.process = process
        self.problem = ""
        """Why entries cannot be written at present; empty if they can."""
        self._instance = instance
        self._path = settings.path
        self._file = AuditFile(settings)
        self._waiting: SimpleQueue[_Waiting | None] = SimpleQueue()
        self._lost = 0
        self._counting = threading.Lock()
        self._closing = threading.Event()
        self._repeated: dict[object, _Repeated] = {}
        self._merging = threading.Lock()  # only the thread adds and removes repetitions
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
        self._thread.start()

    def add(self, entry: _Waiting) -> None:
        """Queue an entry. Any thread may call this. A repetition does not wake the thread that writes."""
        kind = entry.kind
        if kind is not None and kind in self._repeated:
            with self._merging:
                if (known := self._repeated.get(kind)) is not None:
                    known.times += entry.times
                    known.last = entry
                    return
        if self._waiting.qsize() < MAX_WAITING:
            self._waiting.put(entry._replace(what=_brief(entry.what)))
        else:
            with self._counting:
                self._lost += 1

    def close(self) -> None:
        """Wait at most ``CLOSE_S`` until the waiting entries are written, and stop."""
        self._closing.set()
        self._waiting.put(None)
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._closing.is_set() or self._waiting.qsize():
            found = self._batch(self._due_s())
            with self._merging:
                batch = [*self._merge(found)]
            if batch and not self._keep_writing(b"".join(map(self._line, batch))):
                log.error(
                    "%s; this process ends, and %d entries of the audit log are lost",
                    self.problem,
                    len(batch) + self._waiting.qsize(),
                )
                return
        for one in self._repeated.values():
            if one.last is not None:
                self._keep_writing(self._line(one.last._replace(times=one.times)))
        self._file.close()

    def _due_s(self) -> float | None:
        """Return the time in s until an entry for repetitions is due; None if there are no repetitions."""
        if not self._repeated:
            return None
        return max(0.0, min(one.until_s for one in self._repeated.values()) - time.monotonic())

    def _merge(self, batch: list[_Waiting]) -> Iterator[_Waiting]:
        """Yield the entries to write now: new actions of the batch, and repetitions that are due."""
        now_s = time.monotonic()
        for entry in batch:
            kind = entry.kind
            known = None if kind is None else self._repeated.get(kind)
            if known is not None:
                known.times += entry.times
                known.last = entry
                continue
            if kind is not None and len(self._repeated) < MAX_MERGED:
                self._repeated[kind] = _Repeated(now_s + MERGE_S)
            yield entry
        for key, one in list(self._repeated.items()):
            if one.until_s > now_s:
                continue
            if one.last is None:
                del self._repeated[key]
            else:
                yield one.last._replace(times=one.times)
                self._repeated[key] = _Repeated(now_s + MERGE_S)

    def _batch(self, wait_s: float | None) -> list[_Waiting]:
        """Wait up to ``wait_s`` for an entry. Return the waiting entries, at most ``MAX_BATCH``."""
        found: list[_Waiting | None] = []
        try:
            found.append(self._waiting.get(timeout=wait_s))
            while len(found) < MAX_BATCH:
                found.append(self._waiting.get_nowait())
        except Empty:
            pass
        batch = [entry for entry in found if entry is not None]
        with self._counting:
            lost, self._lost = self._lost, 0
        if lost:
            reason = f"more than {MAX_WAITING} entries waited for the disk"
            own = Acting(Actor("process", self.process), self.process)
            batch.append(_Waiting(time.time(), own, "audit", {"entries": lost}, "lost", reason, 0, 0, 1))
        return batch

    def _keep_writing(self, lines: bytes) -> bool:
        """Write lines, and retry until that succeeds. Return False if the process ends first."""
        while True:
            try:
                self._file.append(lines)
            except OSError as error:
                before, self.problem = self.problem, f"audit: {self._path} cannot be written: {error.strerror}"
                if self.problem != before:
                    log.error(
                        "%s; up to %d entries wait for the disk, and shmio still carries out commands",
                        self.problem,
                        MAX_WAITING,
                    )
            else:
                if self.problem:
                    log.warning("the audit log %s can be written again", self._path)
                self.problem = ""
                return True
            if self._closing.wait(RETRY_S):
                return False

    def _line(self, waiting: _Waiting) -> bytes:
        who = waiting.acting
        what = waiting.what
        try:
            what = _brief(what() if callable(what) else what)
        except Exception as error:  # noqa: BLE001  whatever the client has sent, there is an entry
            what = {"error": f"this value cannot be shown: {type(error).__name__}"}
        entry = Entry(
            utc_text(waiting.time_s), self._instance, self.process, os.getpid(), who.endpoint, who.actor.kind,
            _cut(who.actor.name), _cut(who.actor.origin), waiting.action, waiting.outcome,
            _cut(waiting.reason, MAX_REASON), what, getattr(what, "left_out", 0),
            waiting.times, waiting.command, waiting.event,
        )  # fmt: skip
        try:
            return msgspec.json.encode(entry) + b"\n"
        except (UnicodeEncodeError, ValueError, OverflowError):  # text that is not Unicode, or a very large number
            return json.dumps(msgspec.to_builtins(entry)).encode() + b"\n"


_trail: Trail | None = None


def open_trail(settings: AuditSettings | None, instance: str, process: str) -> None:
    """Write this process's entries to an audit log from now on; to none if ``settings`` is None."""
    global _trail  # noqa: PLW0603  one for each process, as for log lines
    close_trail()
    _trail = None if settings is None else Trail(settings, instance, process)


def close_trail() -> None:
    """Write the waiting entries, and stop recording. This waits at most ``CLOSE_S``."""
    global _trail
    trail, _trail = _trail, None
    if trail is not None:
        trail.close()


def problem() -> str:
    """Return why entries of this process cannot be written; empty if they can, or if there is no audit log."""
    return "" if _trail is None else _trail.problem
