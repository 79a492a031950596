"""Commands of other cells: checks who sends them, passes them to the sources, and answers with the outcomes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final

from shmio.audit.trail import Actor, Attempt, acting
from shmio.config.fabric import matches_cell
from shmio.config.model import FabricAllow
from shmio.endpoints.commands_in_flight import MAX_OPEN, CommandCost, InFlightTable
from shmio.endpoints.fabric.feed import Feed
from shmio.errors import CommandError, ConfigError
from shmio.fabric.messages import MAX_WAIT_S, CommandReply, decode_request, encode_command
from shmio.fabric.names import CellName
from shmio.layout.values.write import Write
from shmio.local.writer import REPLACED, RETIRED, SourceWriter
from shmio.model.values import OutcomeKind
from shmio.segment import Block
from shmio.segment.commands import End, apply, decode_writes

EXPIRED: Final = "the command came after its deadline; the source did not begin it"
RESTARTED: Final = "the uplink was restarted after the command was sent; the source did not begin it"
OTHER_LAYOUT: Final = "the layout of the source has changed; read the new layout before you write"

Answer = Callable[[CommandReply], None]
"""Function that is called once for each command, with its outcomes."""

log = logging.getLogger("shmio.fabric")


class CommandClient:
    """Sends commands to one source. Use it only in the event loop's thread."""

    def __init__(self, block: Block, writer: int) -> None:
        self.block = block
        self._source_writer = SourceWriter(block, writer)
        self._in_flight = InFlightTable(writer)
        self._events = block.events.cursor()

    def send(self, writes: Sequence[Write], timeout_s: float, answer: Answer, attempt: Attempt) -> None:
        """Send writes as one command.

        Args:
            writes: The writes.
            timeout_s: Time that the command may wait for the source, in s.
            answer: Called once, with the outcomes.
            attempt: The command's entry in the audit log.

        Raises:
            CommandError: The command was not sent.

        """
        cost = CommandCost.of([len(write.data) for write in writes])
        if self._in_flight and self._in_flight.open_events + cost.events > MAX_OPEN:
            raise CommandError(f"{self.block.source}: too many commands are in flight; wait for their outcomes")
        if self.block.retired:
            raise CommandError(RETIRED)
        if not self._in_flight:
            self._events = self.block.events.cursor()
        ticket = self._source_writer.submit_writes(writes, timeout_s)
        items = [items for _, items in ticket.values]
        self._in_flight.add(ticket, cost, partial(_report, answer, items), attempt=attempt)

    def poll(self) -> None:
        """Read new events, and complete the commands whose outcome is known or overdue."""
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
        outcomes += [str(OutcomeKind[kind.name])] * len(items)
        reasons += [reason] * len(items)
    answer(CommandReply(outcomes, reasons))


class CommandReceiver:
    """Receives the commands of other cells. Use it only in the event loop's thread."""

    def __init__(
        self,
        allow: Sequence[FabricAllow],
        writer: int,
        now_ns: Callable[[], int],
        reply: Callable[[str, bytes], None],
        server: str,
    ) -> None:
        """Create the receiver.

        Args:
            allow: What other cells may do.
            writer: Number of this process's command queue.
            now_ns: Returns the present time on the owner's clock, by which commands expire.
            reply: Sends a message to a subject.
            server: The servers, for the audit log.

        """
        self.received = 0
        self.refused = 0
        """Number of commands that were not sent to a source."""
        self._allow, self._writer, self._now_ns, self._reply, self._server = allow, writer, now_ns, reply, server
        self._clients: dict[int, CommandClient] = {}

    def take(self, sender: str, source: str, feed: Feed | None, stream: int, data: bytes, reply: str) -> None:
        """Handle a command.

        Args:
            sender: Name of the cell that sends the command.
            source: Name of the source.
            feed: The source's feed; None if the cell does not offer this source.
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
            return
        if not reply:  # nobody would know the outcome
            self.refused += 1
            return
        writes = [Write(item.offset, item.mask, item.data) for item in request.writes]
        what: Any = {"source": source} if feed is None else partial(_values, feed.block, writes)
        with acting(Actor("cell", sender, f"server {self._server}"), "fabric"):
            attempt = Attempt("write", what)
        answer = partial(self._answer, reply)
        if not self._may_write(sender):
            why = f"no [[fabric.allow]] of this cell gives {sender} the role write; its owner can add one"
            self._refuse(attempt, answer, len(writes), OutcomeKind.REJECTED, why, "denied")
        elif feed is None:
            why = f"this cell has no source {source!r}"
            self._refuse(attempt, answer, len(writes), OutcomeKind.REJECTED, why)
        elif request.stream != stream:
            self._refuse(attempt, answer, len(writes), OutcomeKind.EXPIRED, RESTARTED, "expired")
        elif request.layout != feed.digest[: len(request.layout)] or not request.layout:
            self._refuse(attempt, answer, len(writes), OutcomeKind.REJECTED, OTHER_LAYOUT)
        elif not feed.publishes(writes):
            why = "a write is outside the registers that this cell publishes of the source"
            self._refuse(attempt, answer, len(writes), OutcomeKind.REJECTED, why)
        elif (rest_s := (request.expires_ns - self._now_ns()) / 1e9) <= 0:
            self._refuse(attempt, answer, len(writes), OutcomeKind.EXPIRED, EXPIRED, "expired")
        else:
            try:
                self._client(feed.block).send(writes, min(rest_s, MAX_WAIT_S), answer, attempt)
            except CommandError as error:
                self._refuse(attempt, answer, len(writes), OutcomeKind.REJECTED, str(error))

    def _refuse(
        self, attempt: Attempt, answer: Answer, items: int, kind: OutcomeKind, why: str, outcome: str = "refused"
    ) -> None:
        self.refused += 1
        attempt.end(outcome, why, refused=True)
        answer(CommandReply([str(kind)] * items, [why] * items))

    def _answer(self, subject: str, reply: CommandReply) -> None:
        self._reply(subject, encode_command(reply))

    def _may_write(self, sender: str) -> bool:
        return any(
            "write" in one.roles and any(matches_cell(pattern, sender) for pattern in one.patterns)
            for one in self._allow
        )

    def _client(self, block: Block) -> CommandClient:
        if block.section not in self._clients:
            self._clients[block.section] = CommandClient(block, self._writer)
        return self._clients[block.section]

    def poll(self, block: Block) -> None:
        """Complete the commands to a source whose outcomes are known."""
        if (client := self._clients.get(block.section)) is not None:
            client.poll()

    def remove(self, block: Block) -> None:
        """End the commands to a source that a reload has replaced."""
        if (client := self._clients.pop(block.section, None)) is not None:
            client.end()


def _values(block: Block, writes: Sequence[Write]) -> Mapping[str, Any]:
    """Return the values that writes set, by path, for the audit log."""
    image = bytearray(block.layout.size)
    apply(image, writes)
    inside = [write for write in writes if write.offset + len(write.data) <= len(image)]
    return {
        f"{block.source}/{path}": value for path, value in decode_writes(block.layout, bytes(image), inside).items()
    }
