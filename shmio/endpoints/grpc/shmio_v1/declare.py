"""Declare: injections that their sources run by themselves, and the record of what is done with them."""

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
from shmio.endpoints.grpc.commands.followers import InjectionFollower
from shmio.endpoints.grpc.shmio_v1.send_queue import SendQueue
from shmio.endpoints.grpc.streams.encoding import field
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.errors import CommandError, ValueRangeError
from shmio.injection import Program
from shmio.layout.topic import names_part
from shmio.local.declared_injections import check
from shmio.messages import declaration_from_wire
from shmio.segment import Block, Event, EventKind
from shmio.wire import shmio_v1_pb2 as wire

MAX_MATCHES: Final = 10_000_000
"""Targets times registers that they are held against, in one call: some seconds."""
SEED_BITS: Final = 53
"""Of a seed that is drawn: any JSON reader keeps it."""

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
    """One call of Declare."""

    def __init__(self, feeds: Mapping[str, Feed], request: wire.DeclareRequest, turn: asyncio.Lock) -> None:
        """``turn``: calls are looked at one after another. ConfigError, ValueRangeError: what is declared cannot be."""
        if len(request.declarations) > MAX_DECLARATIONS:  # before looking at any: nobody is served meanwhile
            raise ValueRangeError(
                f"{len(request.declarations)} injections are declared, {MAX_DECLARATIONS} are the most"
            )
        tables = [declaration_from_wire(one, f"injection[{index}]") for index, one in enumerate(request.declarations)]
        if not tables:
            raise ValueRangeError("no injection is declared")
        self._declarations = [
            msgspec.structs.replace(one, seed=secrets.randbits(SEED_BITS)) if one.seed is None else one
            for one in parse_campaign({"injection": tables})
        ]
        self._feeds = feeds
        self._turn = turn
        self._keep = request.keep
        self._members: list[DeclaredInjection] = []
        self._waiting = SendQueue()  # serialised fields of a DeclareResponse
        self._wake = asyncio.Event()
        self._laid = False
        self._abandoned = False
        self._lifting: asyncio.Task[None] | None = None
        self.over = ""
        """Why it has to end, though something of it stands."""

    async def open(self) -> bytes:
        """Lay all or none; the first message.

        ConfigError, ValueRangeError; CommandError: a source refuses, or does not answer.
        """
        feeds = dict(self._feeds)
        async with self._turn:  # and not on the loop: the registers of a large layout take seconds
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
                    raise CommandError("the client is gone")
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
        self._laid = True
        return field(_DECLARED, declared.SerializeToString()) + self._waiting.all()

    def abandon(self) -> None:
        """Lay no more, and lift what is laid, unless all of it is: the client is gone."""
        self._abandoned = True

    async def close(self) -> None:
        """Lift them, unless they are to be kept. It goes on until their sources have: nobody else would."""
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
        """Serialised DeclareResponses, until nothing of it stands."""
        while True:
            self._wake.clear()  # before looking
            if self._waiting:
                yield self._waiting.all()
            elif self.over or all(member.gone for member in self._members):
                return
            else:
                await self._wake.wait()

    def tell(self, happening: wire.Happening) -> None:
        """Something was done with one of them."""
        if self.over:
            return
        if reason := self._waiting.add(field(_HAPPENINGS, happening.SerializeToString())):
            self.end(reason)
        self._wake.set()

    def end(self, reason: str) -> None:
        """What comes next is not all there was. A client that does not read would hold up the stream's end."""
        self.over = self.over or reason
        if self._laid and not self._keep and self._lifting is None:
            self._lifting = asyncio.get_running_loop().create_task(self._lift())
        self._wake.set()


def _check(
    declarations: Sequence[Declaration], blocks: Mapping[str, Block], wanted: Callable[[], bool]
) -> list[Program]:
    """What they mean; ConfigError; ValueRangeError: too much to look for."""
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
            f"targets that are not just a register, times registers of their source, are more than {MAX_MATCHES}: "
            "declare fewer at once"
        )
    return check(declarations, blocks, wanted)


class DeclaredInjection(InjectionFollower):
    """One injection of a campaign."""

    def __init__(self, campaign: DeclareCall, source: str, commands: CommandClient) -> None:
        self.source = source
        self.commands = commands
        self.number = 0
        self.gone = False
        """Whether it stands no more."""
        self._campaign = campaign

    def happened(self, event: Event) -> None:
        """It was laid, has become active, is no longer, or was lifted."""
        kind = EventKind(event.kind)
        turned = kind in (EventKind.ACTIVATED, EventKind.DEACTIVATED)
        self.gone = kind is EventKind.LIFTED
        self._campaign.tell(
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
        """It was lifted, or its source is gone."""
        if not self.gone:
            self.gone = True
            now_ns = self.commands.block.clock.read().present_ns
            lifted = wire.Happening.KIND_LIFTED
            self._campaign.tell(
                wire.Happening(source=self.source, number=self.number, kind=lifted, clock_ns=now_ns, text=reason)
            )

    def fail(self, reason: str) -> None:
        """The record would have a gap."""
        self._campaign.end(reason)
