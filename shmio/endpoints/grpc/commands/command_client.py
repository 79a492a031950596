"""Commands to one block, and their ends waited for; for the event loop's thread."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any, Final, Unpack

from shmio.config import Declaration
from shmio.endpoints.grpc.commands.block_commands import Inlet
from shmio.endpoints.grpc.commands.followers import Follower
from shmio.endpoints.in_flight import Done, End
from shmio.errors import CommandError
from shmio.layout.values.write import Write
from shmio.local.writer import RETIRED
from shmio.segment import EventKind
from shmio.segment.commands import Laid

RETRY_S: Final = 0.25
"""How soon a source that has not lifted an injection is told again."""

log = logging.getLogger("shmio.grpc")


class Answer:
    """What becomes of a command, to be waited for."""

    def __init__(self) -> None:
        self._ends: asyncio.Future[Sequence[End]] = asyncio.get_running_loop().create_future()

    def done(self, ends: Sequence[End]) -> None:
        """It is known."""
        if not self._ends.done():
            self._ends.set_result(ends)

    def __await__(self) -> Generator[Any, None, Sequence[End]]:
        return self._ends.__await__()


async def write(
    inlet: Inlet, values: Mapping[str, object], timeout_s: float | None = None, *, until_accepted: bool = False
) -> Sequence[End]:
    """Write values by path, as one command; what became of each.

    PathError, ValueRangeError; CommandError: not writable, or the source takes nothing. Nothing has been sent then.
    """
    answer = Answer()
    await inlet.send(values, answer.done, timeout_s=timeout_s, until_accepted=until_accepted)
    return await answer


async def give(inlet: Inlet, injection: int, values: Mapping[str, object], raw: Sequence[Write] = ()) -> Sequence[End]:
    """Give values by path, and raw bytes, as an injection's; what became of them, of neighbours in one."""
    answer = Answer()
    await inlet.give(injection, values, answer.done, raw=raw)
    return await answer


async def lay(inlet: Inlet, bits: bytes, follower: Follower, **laid: Unpack[Laid]) -> int:
    """Lay an injection; its number. CommandError: the source refuses it, or does not answer."""
    return await _laid(inlet, lambda done: inlet.lay(bits, follower, done, **laid))


async def declare(inlet: Inlet, declaration: Declaration, follower: Follower, *, keep: bool) -> int:
    """Lay one that the source runs by itself; its number. CommandError: as of :func:`lay`."""
    return await _laid(inlet, lambda done: inlet.declare(declaration, follower, done, keep=keep))


async def _laid(inlet: Inlet, send: Callable[[Done], int]) -> int:
    _check(inlet)
    answer = Answer()
    number = send(answer.done)
    try:
        ((kind, reason),) = await answer
    except asyncio.CancelledError:
        inlet.followers.remove(number)
        raise
    if kind is EventKind.INJECTED:
        return number
    inlet.followers.remove(number)
    if kind is EventKind.UNKNOWN:  # it may stand
        await lift(inlet, number)
    raise CommandError(f"{inlet.block.source}: {reason}")


async def lift(inlet: Inlet, injection: int) -> str:
    """Lift an injection; why it still stands, or empty."""
    try:
        _check(inlet)
        answer = Answer()
        inlet.lift(injection, answer.done)
        ((_, reason),) = await answer
    except CommandError as error:
        reason = str(error)
    return (reason or "the source has not lifted it yet") if stands(inlet, injection) else ""


async def have_lifted(inlet: Inlet, injection: int, name: str) -> None:
    """Have the source lift one of ours, for as long as that takes: nobody else will while this process lives.

    Its follower is told nothing more. ``name``: what it is called in the log.
    """
    inlet.followers.remove(injection)
    while stands(inlet, injection) and (reason := await lift(inlet, injection)):
        log.warning("%s: an injection is not lifted yet: %s", name, reason)
        await asyncio.sleep(RETRY_S)


def stands(inlet: Inlet, injection: int) -> bool:
    """Whether it still does."""
    standing = inlet.block.standing.read()
    return not inlet.block.retired and any(one.id == injection and not one.lifted for one in standing)


def _check(inlet: Inlet) -> None:
    if inlet.block.retired:
        raise CommandError(RETIRED)
