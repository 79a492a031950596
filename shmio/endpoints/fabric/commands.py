"""Commands of other cells: checks who sends them, passes them to the sources, and answers with the outcomes."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import msgspec

from shmio.audit.trail import MAX_NAMED, Actor, Attempt, acting
from shmio.config.fabric import matches_cell
from shmio.config.model import FabricAllow
from shmio.endpoints.commands_in_flight import MAX_OPEN, WITHOUT_REASON, CommandCost, InFlightTable
from shmio.endpoints.fabric.feed import Feed
from shmio.endpoints.fabric.injections import (
    LEASE_S,
    Lease,
    Leases,
    StateFeed,
    declaration_refusal,
    decode_declaration,
)
from shmio.errors import CommandError, ConfigError
from shmio.fabric.messages import (
    MAX_WAIT_S,
    CommandReply,
    CommandRequest,
    InjectionRequest,
    WriteItem,
    decode_request,
    encode_command,
    outcomes_of,
)
from shmio.fabric.names import CellName
from shmio.layout.values.write import Write, paths_of
from shmio.local.writer import REPLACED, RETIRED, SourceWriter
from shmio.model.values import OutcomeKind
from shmio.segment import Block, CommandKind, EventKind
from shmio.segment.commands import Direction, End, apply, decode_writes
from shmio.wording import not_writable

EXPIRED: Final = "the command came after its deadline; the source did not begin it"
RESTARTED: Final = "the uplink was restarted after the command was sent; the source did not begin it"
OTHER_LAYOUT: Final = "the layout of the source has changed; read the new layout before you write"
DENIED: Final = "denied"
"""Outcome in the audit log of a command whose sender has no role."""
MAX_CHECKS: Final = 32
"""Maximum number of declarations that are checked at the same time; others are rejected."""
_ACTIONS: Final = {"inject": "inject", "shadow": "feed", "lift": "lift", "declare": "declare"}
_THERE: Final = "that cell's supervisor.toml, and reload it"
"""Where a rejected command can be allowed. The reason names the cell, and has to fit an event."""
_HERE: Final = "this cell's supervisor.toml, and reload it"
"""The same place in the audit log of this cell."""
_MAX_NAMED_BYTES: Final = 4096
"""Most bytes of a denied command whose registers are named, so that it costs little time.

For the same reason, only the first items count, as many as the log names.
"""
_KINDS: Final = {
    "inject": CommandKind.INJECT,
    "shadow": CommandKind.SHADOW,
    "lift": CommandKind.LIFT,
    "declare": CommandKind.DECLARE,
}

Answer = Callable[[CommandReply], None]
"""Function that is called once for each command, with its outcomes."""
Refusal = tuple[OutcomeKind, str, str]
"""Why a command is not passed on: the outcome for the sender, the reason, and the outcome in the audit log."""

log = logging.getLogger("shmio.fabric")


class CommandClient:
    """Sends commands to one source. Use it only in the event loop's thread."""

    def __init__(self, feed: Feed, writer: int, feeds: Mapping[str, Feed]) -> None:
        self.block = feed.block
        self.leases = Leases(feed.block, writer)
        self.state = StateFeed(feed, self.leases, feeds)
        self._source_writer = SourceWriter(feed.block, writer)
        self._in_flight = InFlightTable(writer)
        self._events = feed.block.events.cursor()

    def unwritable(self, writes: Sequence[Write]) -> list[str]:
        """Return the paths of what writes set although commands may not write it."""
        return self._source_writer.unwritable(writes)

    def write(self, writes: Sequence[Write], timeout_s: float, answer: Answer, attempt: Attempt) -> None:
        """Send writes as one command.

        Args:
            writes: The writes.
            timeout_s: Time that the command may wait for the source, in s.
            answer: Called once, with the outcomes.
            attempt: The command's entry in the audit log.

        Raises:
            CommandError: The command was not sent.

        """
        self._prepare(cost := CommandCost.of([len(write.data) for write in writes]))
        ticket = self._source_writer.submit_writes(writes, timeout_s)
        items = [items for _, items in ticket.values]
        self._in_flight.add(ticket, cost, partial(_report, answer, items), attempt=attempt)

    def pass_on(
        self, request: InjectionRequest, sender: str, timeout_s: float, answer: Answer, attempt: Attempt
    ) -> None:
        """Send a command about an injection.

        Args:
            request: The command.
            sender: The cell that has sent it.
            timeout_s: Time that the command may wait for the source, in s.
            answer: Called once, with the outcomes.
            attempt: The command's entry in the audit log.

        Raises:
            CommandError: The command was not sent.

        """
        number, kind = request.number, _KINDS[request.kind]
        if number in self._in_flight:
            raise CommandError(f"command {number} is in flight already; send it again under another number")
        if number in self.leases:
            raise CommandError(f"injection {number} exists already; send the command again under another number")
        options: dict[str, Any] = {}
        writes = _writes(request.items)
        if kind is CommandKind.DECLARE:
            writes, options = [Write(0, 0, request.declaration)], {"keep": request.keep}
        elif kind is CommandKind.INJECT:
            options = {"priority": request.priority, "keep": request.keep, "name": request.name}
            options["direction"] = Direction(request.direction)
        self._prepare(cost := CommandCost.of([len(write.data) for write in writes], request.name))
        ticket = self._source_writer.forward(number, kind, writes, timeout_s, request.injection, **options)
        lease = None
        if kind in (CommandKind.DECLARE, CommandKind.INJECT):
            lease = self.leases.add(number, sender, keep=request.keep)
        values = [items for _, items in ticket.values]
        self._in_flight.add(ticket, cost, partial(self._ended, number, lease, answer, values), attempt=attempt)

    def _ended(
        self, number: int, lease: Lease | None, answer: Answer, values: Sequence[range], ends: Sequence[End]
    ) -> None:
        if lease is not None:
            lease.open = False
            if ends[0][0] not in (EventKind.INJECTED, EventKind.UNKNOWN):
                self.leases.remove(number)
        _report(answer, values, [(kind, "" if kind in WITHOUT_REASON else reason) for kind, reason in ends])

    def lift_expired(self) -> None:
        """Lift the injections that their cells no longer renew."""
        for number, lease in self.leases.expired():
            who = f"cell {lease.sender} has not" if lease.sender else "no cell has"
            reason = f"{who} renewed the injection for {LEASE_S:g} s"
            what = {"source": self.block.source, "injection": number}
            with acting(Actor("process", "fabric", reason), "fabric"), Attempt("lift", what) as attempt:
                try:
                    self._lift(number, lease, attempt)
                except CommandError as error:
                    log.warning("%s: injection %d is not lifted yet: %s", self.block.source, number, error)
                    continue
            log.warning("%s: lifting injection %d: %s", self.block.source, number, reason)

    def _lift(self, number: int, lease: Lease, attempt: Attempt) -> None:
        self._prepare(cost := CommandCost.of(()))
        ticket = self._source_writer.ask_to_lift(number)
        lease.open = True
        self._in_flight.add(ticket, cost, partial(self._lifted, lease), attempt=attempt)

    def _lifted(self, lease: Lease, _ends: Sequence[End]) -> None:
        lease.open = False  # if the injection still exists, it is lifted again

    def _prepare(self, cost: CommandCost) -> None:
        """Get ready to send a command.

        Raises:
            CommandError: No command can be sent.

        """
        if self._in_flight and self._in_flight.open_events + cost.events > MAX_OPEN:
            raise CommandError(f"{self.block.source}: too many commands are in flight; wait for their outcomes")
        if self.block.retired:
            raise CommandError(RETIRED)
        if not self._in_flight:
            self._events = self.block.events.cursor()

    def poll(self) -> None:
        """Read new events, and complete the commands whose outcome is known or overdue."""
        self.lift_expired()
        if not self._in_flight:
            return
        while (event := self._events.poll()) is not None:
            self._in_flight.on_event(event)
        if self._events.take_missed():
            self._in_flight.shorten_timeouts()
        self._in_flight.expire()
        if self._events.ended:
            self._in_flight.end(REPLACED)

    def end(self) -> None:
        """End all commands, because a reload has replaced the source, or the uplink stops."""
        self.poll()
        self._in_flight.end(REPLACED)


def _report(answer: Answer, values: Sequence[range], ends: Sequence[End]) -> None:
    """Answer with one outcome for each write. Writes of one value share their outcome."""
    outcomes, reasons = list[str](), list[str]()
    for items, (kind, reason) in zip(values, ends, strict=True):
        outcomes += [str(kind)] * len(items)
        reasons += [reason] * len(items)
    answer(CommandReply(outcomes, reasons))


class CommandReceiver:
    """Receives the commands of other cells. Use it only in the event loop's thread."""

    def __init__(
        self,
        cell: CellName,
        allow: Sequence[FabricAllow],
        writer: int,
        now_ns: Callable[[], int],
        reply: Callable[[str, bytes], None],
        server: str,
        feeds: Mapping[str, Feed],
    ) -> None:
        """Create the receiver.

        Args:
            cell: The cell that receives the commands.
            allow: What other cells may do.
            writer: Number of this process's command queue.
            now_ns: Returns the present time on the owner's clock, by which commands expire.
            reply: Sends a message to a subject.
            server: The servers, for the audit log.
            feeds: The feeds of the sources that the cell offers, by name. They may change.

        """
        self.received = 0
        self.refused = 0
        """Number of commands that were not sent to a source."""
        self._cell, self._allow, self._writer, self._now_ns = cell, allow, writer, now_ns
        self._host = socket.gethostname()
        self._reply, self._server, self._feeds = reply, server, feeds
        self._clients: dict[int, CommandClient] = {}
        self._checks: set[asyncio.Task[None]] = set()

    def take(self, sender: str, source: str, stream: int, data: bytes, reply: str) -> None:
        """Handle a command.

        Args:
            sender: Name of the cell that sends the command.
            source: Name of the source.
            stream: Number of the present numbering of the source's messages.
            data: The encoded command.
            reply: Subject for the answer; empty: the sender does not wait for one.

        """
        self.received += 1
        try:
            request = decode_request(data)
            sender = str(CellName.parse(sender))
        except (ConfigError, ValueError) as error:
            self.refused += 1
            log.warning("a command of %s to source %s is malformed: %s", sender[:120], source, error)
            if reply:
                count, why = outcomes_of(data), f"cell {self._cell} does not understand the command: {error}"
                self._answer(reply, CommandReply([str(OutcomeKind.REJECTED)] * count, [why] * count))
            return
        if not reply:  # nobody would know the outcome
            self.refused += 1
            return
        feed = self._feeds.get(source)
        refusal = self._refusal(request, sender, source, feed, stream)
        answer = partial(self._answer, reply)
        if request.injection is not None and request.injection.kind == "renew":
            if refusal is None and feed is not None:
                self.client(feed).leases.renew(request.injection.renewed, sender)
            kind, why, _ = refusal or (OutcomeKind.ACCEPTED, "", "")
            answer(CommandReply([str(kind)], [why]))
            return
        what: Any = {"source": source}
        if refusal is not None and refusal[2] == DENIED:
            what |= _named(feed, request)
        elif feed is not None:
            what = partial(_described, feed.block, request)
        with acting(Actor("cell", sender, f"server {self._server}"), "fabric"):
            attempt = Attempt("write" if request.injection is None else _ACTIONS[request.injection.kind], what)
        if refusal is not None or feed is None:
            self._refuse(request, attempt, answer, refusal or _rejected(""))
        elif request.injection is not None and request.injection.kind == "declare":
            self._check(request, sender, feed, answer, attempt)
        else:
            self._carry_out(request, sender, feed, answer, attempt)

    def _refusal(
        self, request: CommandRequest, sender: str, source: str, feed: Feed | None, stream: int
    ) -> Refusal | None:
        """Return why a command is not passed on; None if it is."""
        role = "write" if request.injection is None else "inject"
        if not self._may(sender, role):
            why = (
                f"no [[fabric.allow]] gives {sender} the role {role}; to allow it, "
                f"{self._permission(sender, role)} in {_THERE}"
            )
            return OutcomeKind.REJECTED, why, DENIED
        if feed is None:
            return _rejected(f"cell {self._cell} has no source {source!r}")
        if request.stream != stream:
            return OutcomeKind.EXPIRED, RESTARTED, "expired"
        if request.layout != feed.digest[: len(request.layout)] or not request.layout:
            return _rejected(OTHER_LAYOUT)
        if request.injection is not None:
            if why := self._injection_refusal(request.injection, feed):
                return _rejected(why)
        elif not feed.publishes(_writes(request.writes)):
            return _rejected("a write is outside the registers that this cell publishes of the source")
        elif why := self._unwritable(feed, request.writes):
            return _rejected(why)
        return (OutcomeKind.EXPIRED, EXPIRED, "expired") if self._rest_s(request) <= 0 else None

    def _injection_refusal(self, request: InjectionRequest, feed: Feed) -> str:
        """Return why a command about an injection is rejected; empty if it is not."""
        if request.kind == "inject" and not feed.publishes(_writes(request.items)):
            return "the injection covers registers that this cell does not publish of the source"
        toward_device = request.kind == "inject" and request.direction == Direction.IN
        if toward_device and (why := self._unwritable(feed, request.items)):
            return why
        if request.kind in ("lift", "shadow") and feed.partial:
            found = [one for one in feed.block.injections.read() if one.number == request.injection]
            if not all(feed.covers(one.ranges) for one in found):
                return (
                    "the injection also covers registers that this cell does not publish; only its owner can change it"
                )
        return ""

    def _rest_s(self, request: CommandRequest) -> float:
        return (request.expires_ns - self._now_ns()) / 1e9

    def _check(self, request: CommandRequest, sender: str, feed: Feed, answer: Answer, attempt: Attempt) -> None:
        """Check a declaration in a thread, because that may take seconds, then pass it on."""
        if len(self._checks) >= MAX_CHECKS:
            self._refuse(request, attempt, answer, _rejected("too many declarations are in flight"))
            return

        async def check() -> None:
            assert request.injection is not None  # noqa: S101  take() has checked it
            own, feeds = request.injection.declaration, dict(self._feeds)
            try:
                why = await asyncio.to_thread(declaration_refusal, own, feed, feeds)
            except Exception as error:  # the sender must get an outcome
                log.exception("source %s: a declaration of %s cannot be checked", feed.block.source, sender)
                why = f"the declaration cannot be checked: {type(error).__name__}"
            if why:
                self._refuse(request, attempt, answer, _rejected(why))
            elif self._rest_s(request) <= 0:
                self._refuse(request, attempt, answer, (OutcomeKind.EXPIRED, EXPIRED, "expired"))
            else:
                self._carry_out(request, sender, feed, answer, attempt)

        task = asyncio.get_running_loop().create_task(check())
        self._checks.add(task)
        task.add_done_callback(self._checks.discard)

    def _carry_out(self, request: CommandRequest, sender: str, feed: Feed, answer: Answer, attempt: Attempt) -> None:
        timeout_s = min(self._rest_s(request), MAX_WAIT_S)
        try:
            if self._feeds.get(feed.block.source) is not feed:
                raise CommandError(RETIRED)
            with attempt.acting():
                if request.injection is None:
                    self.client(feed).write(_writes(request.writes), timeout_s, answer, attempt)
                else:
                    self.client(feed).pass_on(request.injection, sender, timeout_s, answer, attempt)
        except CommandError as error:
            self._refuse(request, attempt, answer, _rejected(str(error)))

    def _refuse(self, request: CommandRequest, attempt: Attempt, answer: Answer, refusal: Refusal) -> None:
        kind, why, outcome = refusal
        self.refused += 1
        own = f"{why.removesuffix(_THERE)}{_HERE}" if why.endswith(_THERE) else why
        attempt.end(outcome, own, refused=True)
        answer(CommandReply([str(kind)] * request.outcomes, [why] * request.outcomes))

    def _unwritable(self, feed: Feed, items: Sequence[WriteItem]) -> str:
        """Return which registers the source does not let commands write; empty if it does."""
        paths = self.client(feed).unwritable(_writes(items))
        return not_writable(paths, _THERE) if paths else ""

    def _permission(self, sender: str, role: str) -> str:
        """Return what to add to the configuration, so that a cell has a role."""
        if any(matches_cell(pattern, sender) for one in self._allow for pattern in one.patterns):
            return f"add {role!r} to its roles"
        return f'add the lines [[fabric.allow]], sender = "{sender}", roles = ["{role}"]'

    def _answer(self, subject: str, reply: CommandReply) -> None:
        """Send an answer. A reason why this instance rejects a command names the cell and the host."""
        reasons = [
            f"cell {self._cell} on host {self._host}: {why}" if why and kind == OutcomeKind.REJECTED else why
            for kind, why in zip(reply.outcomes, reply.reasons, strict=True)
        ]
        self._reply(subject, encode_command(CommandReply(reply.outcomes, reasons)))

    def _may(self, sender: str, role: str) -> bool:
        return any(
            role in one.roles and any(matches_cell(pattern, sender) for pattern in one.patterns) for one in self._allow
        )

    def client(self, feed: Feed) -> CommandClient:
        """Return the client that sends commands to a source, and knows its injections."""
        section = feed.block.section
        if section not in self._clients:
            self._clients[section] = CommandClient(feed, self._writer, self._feeds)
        return self._clients[section]

    def remove(self, block: Block) -> None:
        """End the commands to a source that a reload has replaced."""
        if (client := self._clients.pop(block.section, None)) is not None:
            client.end()


def _rejected(why: str) -> Refusal:
    return OutcomeKind.REJECTED, why, "refused"


def _writes(items: Sequence[WriteItem]) -> list[Write]:
    return [Write(item.offset, item.mask, item.data) for item in items]


def _named(feed: Feed | None, request: CommandRequest) -> Mapping[str, Any]:
    """Name the registers of a denied command for the audit log.

    The keys are always the same, so that the log merges the commands of a sender that tries all registers.
    """
    items = (request.writes if request.injection is None else request.injection.items)[:MAX_NAMED]
    if feed is None or not items or not request.layout or request.layout != feed.digest[: len(request.layout)]:
        return {}
    if sum(len(item.data) for item in items) > _MAX_NAMED_BYTES:
        return {}
    return {"paths": [f"{feed.block.source}/{path}" for path in paths_of(feed.block.layout, _writes(items), MAX_NAMED)]}


def _described(block: Block, request: CommandRequest) -> Mapping[str, Any]:
    """Describe a command for the audit log. Values are by path."""
    injection = request.injection
    if injection is None:
        return _values(block, _writes(request.writes))
    what: dict[str, Any] = {"source": block.source}
    if injection.kind == "lift":
        return what | {"injection": injection.injection}
    if injection.kind == "shadow":
        return _values(block, _writes(injection.items))
    if injection.kind == "declare":
        try:
            declared = msgspec.to_builtins(decode_declaration(injection.declaration))
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            declared = {}
        return {**declared, **what, "keep": injection.keep}  # as other endpoints record a declaration
    inside = [write for write in _writes(injection.items) if write.offset + len(write.data) <= block.layout.size]
    paths = [f"{block.source}/{path}" for path in paths_of(block.layout, inside, MAX_NAMED)]
    direction = Direction(injection.direction).name.lower()
    return what | {
        "paths": paths, "direction": direction, "priority": injection.priority, "keep": injection.keep,
        "name": injection.name,
    }  # fmt: skip


def _values(block: Block, writes: Sequence[Write]) -> Mapping[str, Any]:
    """Return the values that writes set, by path, for the audit log."""
    image = bytearray(block.layout.size)
    apply(image, writes)
    inside = [write for write in writes if write.offset + len(write.data) <= len(image)]
    return {
        f"{block.source}/{path}": value for path, value in decode_writes(block.layout, bytes(image), inside).items()
    }
