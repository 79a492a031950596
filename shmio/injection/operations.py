"""The operations of declared injections: the table in docs/reference/injections.md.

An operation works on images of the whole block, (size,) of uint8. Its state starts anew with each
activation, and applying it twice in a cycle gives the same result.
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
"""Most memory for the images that one delay holds."""


class OperationContext(NamedTuple):
    """Identifies an image.

    ``run`` is the activation, and ``place`` the number of the cycle or write within it.
    """

    run: int
    place: int
    cycle: int
    time_ns: int


class Operation(ABC):
    """One operation with its state."""

    def begin(self) -> None:  # noqa: B027  most hold nothing
        """Forget all state, because an activation begins."""

    @abstractmethod
    def apply(self, image: Bytes, at: OperationContext) -> None:
        """Change the image in place. The caller keeps only the covered bits."""

    def passed(self, image: Bytes, at: OperationContext) -> None:  # noqa: B027  most need not know
        """Called instead of :meth:`apply` if by chance this image stays unchanged."""

    def resume(self, image: Bytes) -> None:  # noqa: B027
        """Continue for a previous process, which published this image last."""


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
    """``noise``: adds a random number to each number."""

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
    """``random`` from a range; for whole numbers both ends are included."""

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
        """Create it; ``tables`` holds the values (k, size) to choose from for each group."""
        self._tables = tables
        self._draw = draw

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        last = self._tables[-1][0]
        choice = self._draw.below(len(self._tables[0][1]), at.run, at.place, last.first + len(last))
        for group, table in self._tables:
            group.put(image, table, choice[group.first : group.first + len(group)])


class Freeze(Operation):
    """``freeze``: holds the first values of the activation."""

    def __init__(self) -> None:
        self._held: Bytes | None = None

    def begin(self) -> None:
        """Hold the next values."""
        self._held = None

    def resume(self, image: Bytes) -> None:
        """Hold the values that the previous process held."""
        self._held = image.copy()

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: ARG002, D102
        if self._held is None:
            self._held = image.copy()
        image[:] = self._held


class Drop(Operation):
    """``drop`` over ``/out``: a cycle's values are lost, and consumers keep the previous ones.

    The caller decides which cycles are lost, and reports the others by :meth:`passed`.
    """

    def __init__(self) -> None:
        self._held: Bytes | None = None
        self._passing: tuple[int, Bytes] | None = None

    def begin(self) -> None:
        """Forget the held values; the next ones are shown because there are none before them."""
        self._held = self._passing = None

    def resume(self, image: Bytes) -> None:
        """Hold the values that consumers saw last."""
        self._held = image.copy()

    def passed(self, image: Bytes, at: OperationContext) -> None:
        """Take a cycle that is not lost."""
        self._settle(at.cycle)
        self._passing = at.cycle, image.copy()

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        self._settle(at.cycle)
        if self._held is None:
            self._held = image.copy()
        image[:] = self._held

    def _settle(self, cycle: int) -> None:
        """Hold what an earlier cycle showed; a cycle may have several images."""
        if self._passing is not None and self._passing[0] != cycle:
            self._held, self._passing = self._passing[1], None


class Delay(Operation):
    """``delay`` over ``/out``: consumers see what was delivered some time or cycles earlier.

    Until that time has passed since the activation they see its first values.
    """

    def __init__(self, size: int, delay_ns: int, cycles: int) -> None:
        """Create the delay.

        Args:
            size: Size of an image in bytes.
            delay_ns: The delay in ns; 0 if it is in cycles.
            cycles: The delay in cycles; 0 if it is in ns.

        """
        self.delay_ns = delay_ns
        self.cycles = cycles
        self._most = max(2, MAX_DELAY_BYTES // max(1, size))
        self._line: deque[tuple[int, int, Bytes]] = deque()

    def begin(self) -> None:
        """Forget all images."""
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
        """Return whether an image of that cycle and time is to be shown by now."""
        return at.cycle - cycle >= self.cycles if self.cycles else at.time_ns - time_ns >= self.delay_ns


class Flip(Operation):
    """``flip``: inverts the given bits, or a random one of all covered bits."""

    def __init__(self, mask: Bytes | None, cover: Bytes, draw: SeededRandom) -> None:
        """Create it.

        ``mask`` has the bits to invert, or is None for a random bit of ``cover`` each time.
        """
        self._mask = mask
        self._draw = draw
        self._places = np.flatnonzero(np.unpackbits(cover, bitorder="little"))

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        if self._mask is not None:
            image ^= self._mask
            return
        place = int(self._places[self._draw.below(len(self._places), at.run, at.place, 1)[0]])
        image[place // 8] ^= 1 << place % 8
