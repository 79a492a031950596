"""The injections tab: the present injections, campaigns, and the events of all sources."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta
from starlette.concurrency import run_in_threadpool

from shmio.config import Declaration
from shmio.config.campaign import parse_campaign
from shmio.config.read import parse
from shmio.endpoints.web.page import FollowedTab, Nothing, Page, call, release
from shmio.errors import CommandError
from shmio.injection.condition import Memory
from shmio.injection.language import Number
from shmio.injection.program import Decoder, compile_condition
from shmio.layout.values.write import Write, bits_of, paths_of
from shmio.local.injection import Campaign, compile_declarations
from shmio.model.clock import ClockMode
from shmio.segment import Block, Quality
from shmio.segment.block import Layouts
from shmio.segment.injection_list import InjectionEntry

INTERVAL_S: Final = 0.5
"""Interval in s at which injections and events are sent, if they have changed."""
MAX_INJECTIONS: Final = 500
"""Maximum number of injections that are shown."""
MAX_PATHS: Final = 20
"""Maximum number of paths that are shown for an injection or an event."""
MAX_COUNTED: Final = 4_096
"""Maximum number of registers that are counted for an injection."""
MAX_CAMPAIGNS: Final = 16
"""Maximum number of campaigns that one page may run at the same time."""
MAX_CONDITION: Final = 1_000
"""Maximum number of characters of a condition."""
MAX_CAMPAIGN: Final = 60_000
"""Maximum number of characters of a campaign."""


class Given(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of a call about a campaign: its text, in TOML."""

    text: Annotated[str, Meta(max_length=MAX_CAMPAIGN)]
    keep: bool = False
    """True if the injections continue after the page has been closed."""


class Typed(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``condition``: a condition, as the user is typing it."""

    when: Annotated[str, Meta(max_length=MAX_CONDITION)]


class Chosen(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``lift``: the source and the number of an injection."""

    source: Annotated[str, Meta(max_length=200)]
    number: Annotated[str, Meta(pattern="^[0-9]{1,20}$")]
    """The number as text, because JavaScript has no exact integers above 2**53."""


class Injections(FollowedTab):
    """Shows, starts and lifts injections, and shows the events of all sources."""

    name: ClassVar[str] = "injections"

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._campaigns: list[Campaign] = []

    def close(self) -> None:
        """Lift the injections of this page's campaigns, except those with ``keep``."""
        campaigns, self._campaigns = self._campaigns, []
        if campaigns:
            named = {", ".join(f"{one.source}: {one.name}" for one in held.declared): held for held in campaigns}
            asyncio.get_running_loop().run_in_executor(None, release, named, self.page.user)

    @call("inject", Chosen)
    async def lift(self, given: Chosen) -> None:
        """Lift an injection, whichever program has created it."""
        await run_in_threadpool(self.page.served.cell.lift, given.source, int(given.number))

    @call("inject", Nothing)
    async def lift_all(self, _: Nothing) -> int:
        """Lift all injections on all sources. Return their number."""
        return len(await run_in_threadpool(self.page.served.cell.lift_all))

    @call("read", Given)
    async def check(self, given: Given) -> list[dict[str, Any]]:
        """Check a campaign, and return the injections that it would make. Nothing is started."""
        return await self.page.turn.in_thread(self._preview, given.text)

    @call("read", Typed)
    async def condition(self, given: Typed) -> dict[str, Any]:
        """Return whether a condition is true at present (None if unknown), and the values that it reads."""
        blocks = self.page.served.segment.blocks
        condition = compile_condition(given.when, Layouts(blocks))
        values = [_present(blocks[source], codec) for source, codec in condition.reads]
        shown = zip(condition.expression.references, values, strict=True)
        return {
            "holds": condition.expression.evaluate(values, Memory()),
            "values": [[path, None if value is None else json.dumps(value)] for path, value in shown],
        }

    @call("inject", Given)
    async def start(self, given: Given) -> list[dict[str, Any]]:
        """Start a campaign: all of its injections or none."""
        self._campaigns = [one for one in self._campaigns if self._runs(one)]
        if len(self._campaigns) >= MAX_CAMPAIGNS:
            raise CommandError(f"a page may run at most {MAX_CAMPAIGNS} campaigns at a time; lift one first")
        declarations = _parse(given.text)
        cell = self.page.served.cell
        campaign = await run_in_threadpool(lambda: cell.declare(declarations, keep=given.keep))
        self._campaigns.append(campaign)
        return [
            {"source": one.source, "number": str(one.number), "name": one.name, "seed": str(one.seed)}
            for one in campaign.declared
        ]

    def _runs(self, campaign: Campaign) -> bool:
        present = {one.number for one in self.page.served.cell.injections()}
        return any(one.number in present for one in campaign.declared)

    def _preview(self, text: str) -> list[dict[str, Any]]:
        blocks = self.page.served.segment.blocks
        return [
            _described_declaration(program.declaration)
            | _first_paths(f"{program.source}/{path}" for path in _covered(blocks[program.source], program.cover))
            for program in compile_declarations(_parse(text), blocks)
        ]

    async def _follow(self) -> None:
        present: dict[str, tuple[Any, ...]] | None = None
        events: list[dict[str, Any]] | None = None
        while True:
            blocks = self.page.served.segment.blocks
            before, present = present, {source: block.injections.read() for source, block in blocks.items()}
            if present != before:
                names = {one["pid"]: one["name"] for one in self.page.served.overview()["processes"]}
                self.page.push("injections", await self.page.turn.in_thread(self._describe, present, names))
            earlier, events = events, self.page.served.timeline.events()
            if events != earlier:
                self.page.push("events", events)
            await asyncio.sleep(INTERVAL_S)

    def _describe(self, present: dict[str, tuple[Any, ...]], names: dict[int, str]) -> list[dict[str, Any]]:
        """Describe injections, with the names of the instance's processes by pid."""
        blocks = self.page.served.segment.blocks
        clock = self.page.served.cell.clock
        utc_s = time.time() - clock.present_ns / 1e9 if clock.mode is ClockMode.WALL else None
        found: list[dict[str, Any]] = []
        for source, injections in present.items():
            layout = blocks[source].layout
            for one in injections[: MAX_INJECTIONS - len(found)]:
                bits = (Write(offset, mask, bytes(size)) for offset, size, mask in one.ranges)
                paths = (f"{source}/{path}" for path in paths_of(layout, bits, MAX_COUNTED))
                running = one.running
                found.append(
                    {
                        "source": source,
                        "number": str(one.number),  # JavaScript has no exact numbers above 2**53
                        "name": one.name,
                        "direction": one.direction,
                        "priority": one.priority,
                        "keep": one.keep,
                        "by": _creator(one, names),
                        "state": "active" if running is None else running.state,
                        "since_s": running.time_ns / 1e9 if running is not None and running.time_ns else None,
                        "utc_s": None if utc_s is None or running is None else utc_s + running.time_ns / 1e9,
                        "seed": None if running is None else str(running.seed),
                    }
                    | ({} if running is None else _described_declaration(running.declaration))
                    | _first_paths(paths)
                )
        return found


def _creator(one: InjectionEntry, names: Mapping[int, str]) -> str:
    """Return what has created an injection; ``names`` are the names of the instance's processes by pid."""
    if one.cell:
        who = f"process {one.pid}" if one.pid else "a program"
        return f"{one.cell} (configuration)" if one.configured else f"{who} of {one.cell}"
    return "configuration" if one.configured else one.endpoint or names.get(one.pid) or f"process {one.pid}"


def _present(block: Block, codec: Decoder) -> Number | None:
    """Return the present value of a register, by the rules for conditions of injections; None: unknown."""
    frame = block.latest()
    if frame is None or not frame.source_ns or block.assess(frame)[0] is Quality.BAD:
        return None
    value = codec.decode(frame.raw)
    return value if isinstance(value, bool | int | float) else None


def _parse(text: str) -> list[Declaration]:
    """Return the declarations in a campaign.

    Raises:
        ConfigError: The text is not TOML, is nested too deeply, or a declaration is wrong.

    """
    return parse_campaign(parse(Path("campaign"), text))


def _described_declaration(declaration: Declaration) -> dict[str, Any]:
    return {"name": declaration.name, "operation": declaration.operation, "when": declaration.when}


def _covered(block: Block, cover: Any) -> Iterator[str]:
    """Yield the paths of the registers of which ``cover`` includes at least one bit."""
    mask = bytes(cover)
    for register in block.layout.own:
        share = mask[register.offset : register.offset + register.size]
        if any(bits & covered for bits, covered in zip(bits_of(register), share, strict=True)):
            yield register.path


def _first_paths(paths: Iterable[str]) -> dict[str, Any]:
    found = list(islice(paths, MAX_COUNTED))
    return {"registers": found[:MAX_PATHS], "count": len(found)}
