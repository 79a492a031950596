"""Methods with which clients step virtual time and lift injections."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any, Final

from asyncua import ua
from asyncua.common.utils import ServiceError

from shmio.endpoints.opcua.nodes import Method, Node, Property, SourceNode
from shmio.errors import CommandError, TimeError
from shmio.local.time_control import Coordinator
from shmio.segment import EventKind, Segment

PATIENCE_S: Final = 2.0
"""Maximum time in s for which a step waits until another program releases control of the clock."""


class Stepping:
    """Steps virtual time for clients. Use it only in the event loop's thread."""

    def __init__(self, segment: Segment) -> None:
        self.lock = asyncio.Lock()
        """Locked during a step."""
        self._segment = segment
        self._coordinator = Coordinator(segment)

    async def step(self, length_ms: float) -> list[ua.Variant]:
        """Step virtual time.

        Args:
            length_ms: Length of the step, in ms; 0 for the step size.

        Returns:
            The step's number, and the instance time after the step, in s.

        Raises:
            ServiceError: The length is not valid.
            ShmioError: Time is real, another program controls the clock, or the step failed.

        """
        if not math.isfinite(length_ms) or length_ms < 0:
            raise ServiceError(ua.StatusCodes.BadOutOfRange)
        async with self.lock:
            return await asyncio.to_thread(self._step, round(length_ms * 1e6) or None)

    def _step(self, length_ns: int | None) -> list[ua.Variant]:
        if not self._segment.clock.read().virtual:
            raise TimeError("time is real; first take control of it, for example with shmio step")
        try:
            self._coordinator.take_over(PATIENCE_S, steps=True)
            done = self._coordinator.step(length_ns)
        finally:
            self._coordinator.close()
        return [ua.Variant(done.number, ua.VariantType.UInt64), ua.Variant(done.time_ns / 1e9, ua.VariantType.Double)]


def add_step(root: Node, stepping: Stepping) -> None:
    """Add a method that steps virtual time to the instance's object, ``root``."""
    method = Method(root, "Step", "control", "Steps virtual time; it returns when all sources are done", stepping.step)
    method.inputs = [_argument("Length", ua.ObjectIds.Double, "in ms; 0: the step size")]
    method.outputs = [
        _argument("Number", ua.ObjectIds.UInt64, "number of the step"),
        _argument("Time", ua.ObjectIds.Double, "the instance's time after it, in s"),
    ]
    root.children["#Step"] = method


def add_injections(source: SourceNode) -> None:
    """Add to a source's object the list of its injections, and methods that lift them."""
    block, commands = source.feed.block, source.feed.commands

    def present() -> dict[int, str]:
        return {one.number: f"{one.name} ({one.direction})" for one in block.injections.read() if not one.lifted}

    async def lift(number: int) -> list[ua.Variant]:
        if number not in present():
            raise ServiceError(ua.StatusCodes.BadNotFound)
        kind, reason = await commands.lift(number)
        if kind is not EventKind.LIFTED and number in present():
            raise CommandError(f"{source.name}: injection {number} was not lifted: {reason}")
        return []

    async def lift_all() -> list[ua.Variant]:
        numbers = list(present())
        for number in numbers:
            if number in present():  # another program may have lifted it meanwhile
                await lift(number)
        return [ua.Variant(len(numbers), ua.VariantType.UInt32)]

    one = Method(source, "Lift", "inject", "Lifts an injection of any program", lift)
    one.inputs = [_argument("Number", ua.ObjectIds.UInt64, "as in Injections")]
    every = Method(source, "LiftAll", "inject", "Lifts all injections of this source, of all programs", lift_all)
    every.outputs = [_argument("Lifted", ua.ObjectIds.UInt32, "number of injections")]
    listed = Property(
        source,
        "Injections",
        ua.ObjectIds.String,
        _texts(lambda: [f"{n}: {text}" for n, text in present().items()]),
    )
    listed.sizes = [0]
    for node in (one, every, listed):
        source.children[f"#{node.name}"] = node


def _texts(get: Callable[[], list[str]]) -> Callable[[], ua.Variant]:
    return lambda: ua.Variant(get(), ua.VariantType.String, is_array=True)


def _argument(name: str, kind: int, text: str) -> Any:
    return ua.Argument(Name=name, DataType=ua.NodeId(kind), ValueRank=-1, Description=ua.LocalizedText(text))
