"""What an injection makes of the bits it covers: the table of operations, docs/reference/injections.md.

An operation works on images of the whole block, (size,) of uint8. What it holds begins anew with each activation, and
looking at a cycle twice changes nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from shmio.injection.draw import SeededRandom
from shmio.injection.numbers import Bytes, Change, ValueGroup

MAX_DELAY_CYCLES: Final = 10_000
MAX_DELAY_BYTES: Final = 16_000_000
"""The most that the images held by one delay take."""


class OperationContext(NamedTuple):
    """Which image: in the activation ``run`` that of ``place``, its cycles (over ``/in``: its writes) so far."""

    run: int
    place: int
    cycle: int
    time_ns: int


class Operation(ABC):
    """One operation, as it goes on."""

    def begin(self) -> None:  # noqa: B027  most hold nothing
        """An activation begins: forget what was held."""

    @abstractmethod
    def apply(self, image: Bytes, at: OperationContext) -> None:
        """Change the image in place; what is not covered may change, too: the caller takes what is."""

    def passed(self, image: Bytes, at: OperationContext) -> None:  # noqa: B027  most need not know
        """Told instead of :meth:`apply`: by chance this image stays as it is."""

    def resume(self, image: Bytes) -> None:  # noqa: B027
        """Go on for a process before this one, which showed this image last."""


class Fixed(Operation):
    """``set``: the same values in each cycle."""

    def __init__(self, values: Bytes) -> None:
        self._values = values

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: ARG002, D102
        image[:] = self._values


class Arithmetic(Operation):
    """``offset``, ``scale``, ``clamp``: new numbers from the old ones."""

    def __init__(self, places: Sequence[ValueGroup], change: Change) -> None:
        self._places = places
        self._change = change

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: ARG002, D102
        with np.errstate(all="ignore"):
            for group in self._places:
                group.put_numbers(image, self._change(group, group.numbers(image)))


class Noise(Operation):
    """``noise``: to each number another random one is added."""

    def __init__(self, places: Sequence[ValueGroup], draw: SeededRandom, amplitude: float, *, gaussian: bool) -> None:
        self._places = places
        self._draw = draw
        self._amplitude = amplitude
        self._gaussian = gaussian

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        count = self._places[-1].first + len(self._places[-1])
        if self._gaussian:
            noise = self._draw.gaussian(at.run, at.place, count) * self._amplitude
        else:
            noise = (2 * self._draw.uniform(at.run, at.place, count) - 1) * self._amplitude
        with np.errstate(all="ignore"):
            for group in self._places:
                own = noise[group.first : group.first + len(group)]
                group.put_numbers(image, group.numbers(image) + own)


class RandomRange(Operation):
    """``random`` from a range, both ends included for whole numbers."""

    def __init__(self, places: Sequence[ValueGroup], draw: SeededRandom, least: float, most: float) -> None:
        self._places = places
        self._draw = draw
        self._least = least
        self._most = most

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        count = self._places[-1].first + len(self._places[-1])
        share = self._draw.uniform(at.run, at.place, count)
        for group in self._places:
            own = share[group.first : group.first + len(group)]
            if group.dtype.kind == "f":
                values = self._least + own * (self._most - self._least)
            else:
                values = np.ceil(self._least) + np.floor(own * (np.floor(self._most) - np.ceil(self._least) + 1))
            group.put_numbers(image, values)


class RandomChoice(Operation):
    """``random`` from a set."""

    def __init__(self, tables: Sequence[tuple[ValueGroup, Bytes]], draw: SeededRandom) -> None:
        """``tables``: places with the values (k, size) to choose from."""
        self._tables = tables
        self._draw = draw

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        last = self._tables[-1][0]
        choice = self._draw.below(len(self._tables[0][1]), at.run, at.place, last.first + len(last))
        for group, table in self._tables:
            group.put(image, table, choice[group.first : group.first + len(group)])


class Freeze(Operation):
    """``freeze``: the first values since the activation are held."""

    def __init__(self) -> None:
        self._held: Bytes | None = None

    def begin(self) -> None:
        """Hold what comes next."""
        self._held = None

    def resume(self, image: Bytes) -> None:
        """Hold what that one did."""
        self._held = image.copy()

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: ARG002, D102
        if self._held is None:
            self._held = image.copy()
        image[:] = self._held


class Drop(Operation):
    """``drop`` over ``/out``: the cycle's values are lost, consumers keep those of the cycle before.

    Which cycles are lost is decided by who calls; it tells of the others by :meth:`passed`.
    """

    def __init__(self) -> None:
        self._held: Bytes | None = None
        self._passing: tuple[int, Bytes] | None = None

    def begin(self) -> None:
        """What comes next is shown, for there is nothing before it."""
        self._held = self._passing = None

    def resume(self, image: Bytes) -> None:
        """Keep what consumers have seen."""
        self._held = image.copy()

    def passed(self, image: Bytes, at: OperationContext) -> None:
        """A cycle that is not lost."""
        self._settle(at.cycle)
        self._passing = at.cycle, image.copy()

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        self._settle(at.cycle)
        if self._held is None:
            self._held = image.copy()
        image[:] = self._held

    def _settle(self, cycle: int) -> None:
        """What an earlier cycle has shown is what is kept; of one cycle several images may come."""
        if self._passing is not None and self._passing[0] != cycle:
            self._held, self._passing = self._passing[1], None


class Delay(Operation):
    """``delay`` over ``/out``: consumers see what was delivered a time, or so many cycles, before.

    Until that time has passed since the activation they see its first values.
    """

    def __init__(self, size: int, delay_ns: int, cycles: int) -> None:
        """``size``: bytes of an image; of ``delay_ns`` and ``cycles`` the other one is 0."""
        self.delay_ns = delay_ns
        self.cycles = cycles
        self._most = max(2, MAX_DELAY_BYTES // max(1, size))
        self._line: deque[tuple[int, int, Bytes]] = deque()

    def begin(self) -> None:
        """The line is empty."""
        self._line.clear()

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        if self._line and self._line[-1][0] == at.cycle:
            self._line.pop()
        self._line.append((at.cycle, at.time_ns, image.copy()))
        while len(self._line) > self._most or (
            len(self._line) > 1 and self.due(self._line[1][0], self._line[1][1], at)
        ):
            self._line.popleft()
        image[:] = self._line[0][2]

    def due(self, cycle: int, time_ns: int, at: OperationContext) -> bool:
        """Whether what came then is to be seen by now."""
        return at.cycle - cycle >= self.cycles if self.cycles else at.time_ns - time_ns >= self.delay_ns


class Flip(Operation):
    """``flip``: bits are turned over, the given ones, or a random one of all that are covered."""

    def __init__(self, mask: Bytes | None, cover: Bytes, draw: SeededRandom) -> None:
        """``mask``: the bits to turn; None: a random one of ``cover`` in each cycle or write."""
        self._mask = mask
        self._draw = draw
        self._places = np.flatnonzero(np.unpackbits(cover, bitorder="little"))

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        if self._mask is not None:
            image ^= self._mask
            return
        place = int(self._places[self._draw.below(len(self._places), at.run, at.place, 1)[0]])
        image[place // 8] ^= 1 << place % 8
