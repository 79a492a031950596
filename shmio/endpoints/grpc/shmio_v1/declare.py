"""The call Declare: creates injections that their sources run, and streams a record of their events."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from typing import Final

import msgspec

from shmio.config import Declaration
from shmio.config.campaign import parse_campaign
from shmio.config.declaration import MAX_DECLARATIONS
from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.commands.command_client import CommandClient
from shmio.endpoints.grpc.commands.injections import InjectionFollower
from shmio.endpoints.grpc.encoding import field
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import SendQueue
from shmio.errors import CommandError, ValueRangeError
from shmio.injection import Program
from shmio.layout.topic import names_part
from shmio.local.injection import compile_declarations
from shmio.messages import declaration_from_wire
from shmio.segment import Block, Event, EventKind
from shmio.wire import shmio_v1_pb2 as wire

MAX_MATCHES: Final = 10_000_000
"""Maximum number of comparisons between a target and a register in one call.

This many comparisons take a few seconds.
"""
SEED_BITS: Final = 53
"""Number of bits of a random seed. Any JSON reader reads integers of this size exactly."""

_DECLARED, _HAPPENINGS = (
    wire.DeclareResponse.DESCRIPTOR.fields_by_name[name].number for name in ("declared", "happenings")
)
_KINDS: Final = {
    EventKind.INJECTED: wire.Happening.KIND_INJECTED,
    EventKind.ACTIVATED: wire.Happening.KIND_ACTIVATED,
    EventKind.DEACTIVATED: wire.Happening.KIND_DEACTIVATED,
    EventKind.LIFTED: wire.Happening.KIND_LIFTED,
}


class DeclareCall:
    """A Declare call, with its injections."""

    def __init__(self, feeds: Mapping[str, Feed], request: wire.DeclareRequest, lock: asyncio.Lock) -> None:
        """Check the declarations.

        Args:
            feeds: The feeds of all sources, by name.
            request: The request of the call.
            lock: The lock that each call holds while it checks its declarations.

        Raises:
            ConfigError: A declaration is not valid.
            ValueRangeError: There are no declarations or too many, or a value in one is not valid.

        """
        if len(request.declarations) > MAX_DECLARATIONS:  # checked first, as parsing blocks the event loop
            raise ValueRangeError(
                f"{len(request.declarations)} injections are declared, but at most {MAX_DECLARATIONS} are allowed"
            )
        tables = [declaration_from_wire(one, f"injection[{index}]") for index, one in enumerate(request.declarations)]
        if not tables:
            raise ValueRangeError("no injection is declared")
        self._declarations = [
            msgspec.structs.replace(one, seed=secrets.randbits(SEED_BITS)) if one.seed is None else one
            for one in parse_campaign({"injection": tables})
        ]
        self._feeds = feeds
        self._lock = lock
        self._keep = request.keep
        self._members: list[DeclaredInjection] = []
        self._waiting = SendQueue()  # serialised fields of a DeclareResponse
        self._wake = asyncio.Event()
        self._complete = False
        self._abandoned = False
        self._lifting: asyncio.Task[None] | None = None
        self.over = ""
        """Why the call must end before its injections; otherwise empty."""

    async def open(self) -> bytes:
        """Create all injections or none, and return the first message.

        Raises:
            ConfigError: A declaration does not fit the sources.
            ValueRangeError: There are too many targets to compare.
            CommandError: A source refused an injection, or does not answer.

        """
        feeds = dict(self._feeds)
        async with self._lock:  # in a thread: a large layout takes seconds
            programs = await asyncio.to_thread(
                _check,
                self._declarations,
                {source: feed.block for source, feed in feeds.items()},
                lambda: not self._abandoned,
            )
        declared = wire.Declared()
        try:
            for program in programs:
                declaration = program.declaration
                member = DeclaredInjection(self, program.source, feeds[program.source].commands)
                if self._abandoned:
                    raise CommandError("the client has disconnected")
                try:
                    member.number = await command_client.declare(member.commands, declaration, member, keep=self._keep)
                except CommandError as error:
                    raise CommandError(f'{error} (injection "{declaration.name}")') from None
                self._members.append(member)
                declared.injections.add(
                    source=program.source, number=member.number, name=declaration.name, seed=declaration.seed or 0
                )
        except BaseException:
            await self._lift()
            raise
        self._complete = True
        return field(_DECLARED, declared.SerializeToString()) + self._waiting.all()

    def abandon(self) -> None:
        """Stop creating injections, because the client has disconnected.

        If :meth:`open` is still creating injections, it lifts those that it has created.
        """
        self._abandoned = True

    async def close(self) -> None:
        """Lift the injections, unless the client has asked to keep them. Retry until that succeeds."""
        if self._lifting is not None:
            await self._lifting
        elif not self._keep:
            await self._lift()
        for member in self._members:
            member.commands.followers.remove(member.number)

    async def _lift(self) -> None:
        await asyncio.gather(
            *(command_client.have_lifted(one.commands, one.number, one.source) for one in self._members if not one.gone)
        )

    async def messages(self) -> AsyncIterator[bytes]:
        """Yield serialised DeclareResponses.

        The iteration ends when all injections have ended, or when the client is too slow
        (:meth:`end`).
        """
        while True:
            self._wake.clear()  # before the checks, so that no wake-up is lost
            if self._waiting:
                yield self._waiting.all()
            elif self.over or all(member.gone for member in self._members):
                return
            else:
                await self._wake.wait()

    def add_event(self, event: wire.Happening) -> None:
        """Queue an event of one of the injections for the client."""
        if self.over:
            return
        if reason := self._waiting.add(field(_HAPPENINGS, event.SerializeToString())):
            self.end(reason)
        self._wake.set()

    def end(self, reason: str) -> None:
        """End the call, because its record has a gap.

        This lifts the injections at once, unless the client has asked to keep them: a client that
        does not read could delay the end of the stream.
        """
        self.over = self.over or reason
        if self._complete and not self._keep and self._lifting is None:
            self._lifting = asyncio.get_running_loop().create_task(self._lift())
        self._wake.set()


def _check(
    declarations: Sequence[Declaration], blocks: Mapping[str, Block], wanted: Callable[[], bool]
) -> list[Program]:
    """Check declarations and compile them to programs.

    Raises:
        ConfigError: A declaration does not fit the sources.
        ValueRangeError: There are too many targets to compare.

    """
    matches = 0
    for declaration in declarations:
        for target in [declaration.target] if isinstance(declaration.target, str) else declaration.target:
            source, _, path = target.removesuffix("/in").removesuffix("/out").partition("/")
            block = blocks.get(source)
            if block is None or not (path in block.layout.by_path or (names_part(path) and "*" not in path)):
                looked_at = [block] if block else blocks.values()
                matches += max((len(one.layout.registers) for one in looked_at), default=0)
    if matches > MAX_MATCHES:
        raise ValueRangeError(
            f"the targets that do not name a register exactly need more than {MAX_MATCHES} comparisons with registers; "
            "declare fewer injections at once"
        )
    return compile_declarations(declarations, blocks, wanted)


class DeclaredInjection(InjectionFollower):
    """An injection of a Declare call."""

    def __init__(self, campaign: DeclareCall, source: str, commands: CommandClient) -> None:
        self.source = source
        self.commands = commands
        self.number = 0
        self.gone = False
        """True if the injection has ended."""
        self._campaign = campaign

    def on_event(self, event: Event) -> None:
        """Record that the injection was created, activated, deactivated or lifted."""
        kind = EventKind(event.kind)
        turned = kind in (EventKind.ACTIVATED, EventKind.DEACTIVATED)
        self.gone = kind is EventKind.LIFTED
        self._campaign.add_event(
            wire.Happening(
                source=self.source,
                number=event.injection,
                kind=_KINDS[kind],
                clock_ns=event.clock_ns,
                utc_ns=event.utc_ns,
                frame=event.frame,
                cycle=event.cycle,
                run=event.item if turned else 0,
                text=event.text if self.gone else "",
            )
        )

    def lifted(self, reason: str) -> None:
        """Record the end of the injection, unless an event has recorded it already."""
        if not self.gone:
            self.gone = True
            now_ns = self.commands.block.clock.read().present_ns
            lifted = wire.Happening.KIND_LIFTED
            self._campaign.add_event(
                wire.Happening(source=self.source, number=self.number, kind=lifted, clock_ns=now_ns, text=reason)
            )

    def fail(self, reason: str) -> None:
        """End the call, because its record would have a gap."""
        self._campaign.end(reason)
