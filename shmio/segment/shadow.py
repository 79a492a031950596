"""An injection as the program that laid it holds it."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Self

from shmio.layout.topic import parse_topic
from shmio.segment.commander import Commander, Outcome
from shmio.segment.commands import Direction


class Shadow:
    """A shadow over registers of one source. Leaving its ``with`` block lifts it, unless it is to be kept.

    Until it is given values, consumers go on seeing what they saw; over ``/in``, nothing reaches the device.
    """

    def __init__(self, commander: Commander, number: int, direction: Direction, *, keep: bool) -> None:
        self.source = commander.block.source
        self.number = number
        """By which anybody may lift it, or give values to it."""
        self.direction = direction
        self._commander = commander
        self._keep = keep

    def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Give values by path, with or without the source: to consumers, or over ``/in`` toward the device.

        What became of each: SHADOWED, consumers see it; over ``/in`` as with a write. REJECTED: not covered, or the
        shadow was lifted. PathError, ValueRangeError, CommandError: nothing has been sent.
        """
        paths = {parse_topic(path, (self.source,), self.source).path: value for path, value in values.items()}
        return self._commander.shadow(self.number, paths, timeout_s)

    def lift(self) -> None:
        """Lift it; consumers see what the source delivers. CommandError: it was lifted already, or no answer came."""
        self._commander.lift(self.number)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._keep:
            self.lift()
