"""The operations of declared injections, as listed in docs/reference/injections.md.

An operation changes images of a whole block, which are arrays of shape (size,) and type uint8. A
``ValueGroup`` reads and writes all values of one type in an image at once. Each activation resets
the operation's state. If an operation is applied twice in a cycle, the results are the same.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from shmio.injection._numbers import Number, change_all
from shmio.injection.draw import SeededRandom
from shmio.layout.model import ByteOrder, ElementType, Register, bit_positions
from shmio.layout.values.codec import REAL_MAX, scalar_codec

if TYPE_CHECKING:
    from shmio.injection._numbers import Change

Bytes = npt.NDArray[np.uint8]
Values = npt.NDArray[Any]
_MAX_ELEMENTS: Final = 4096
"""Maximum number of single values in one injection, because more would make the poll loop too slow."""
MAX_DELAY_CYCLES: Final = 10_000
MAX_DELAY_BYTES: Final = 16_000_000
"""Maximum number of bytes of all images that one ``delay`` stores."""
_REAL_LIMIT: Final = float(np.float32(REAL_MAX))
_NUMPY: Final = {
    "b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4", "q": "i8", "Q": "u8", "f": "f4", "d": "f8",
}  # fmt: skip


# -- values --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ValueGroup:
    """All single values of one type in an injection's target.

    The values in all groups of an injection are numbered. ``first`` is the number of the first value
    in this group.
    """

    element: ElementType
    first: int
    index: npt.NDArray[np.intp]
    """Offsets of the values' bytes in the block: an array of shape (n, size), or (n,) for bits."""
    shifts: Bytes
    """For bits only: the number of each bit in its byte, an array of shape (n,)."""
    dtype: np.dtype[Any]
    """The numpy type of the values in the image. Its kind is V if the values are not numbers."""

    def __len__(self) -> int:
        return len(self.index)

    @cached_property
    def span(self) -> slice | None:
        """The range of bytes that the values take in the block, if they are contiguous; else None."""
        flat = self.index.ravel()
        first = int(flat[0])
        return slice(first, first + len(flat)) if (np.diff(flat) == 1).all() else None

    @cached_property
    def limits(self) -> tuple[Any, Any]:
        """The smallest and the largest number of the type, for comparison with the result of :meth:`numbers`."""
        if self.dtype.kind == "f":
            most = _REAL_LIMIT if self.dtype.itemsize == 4 else float(np.finfo(np.float64).max)
            return -most, most
        bounds, exact = np.iinfo(self.dtype), np.longdouble if self.dtype.itemsize == 8 else np.float64
        return exact(bounds.min), exact(bounds.max)

    def numbers(self, image: Bytes) -> Values:
        """Return the values in an image as an array of shape (n,) and type float64.

        For 64-bit integers, the type is long double, because a double would lose digits.
        """
        exact = np.longdouble if self.dtype.kind in "iu" and self.dtype.itemsize == 8 else np.float64
        if self.span is not None:
            return image[self.span].view(self.dtype).astype(exact)
        return np.ascontiguousarray(image[self.index]).view(self.dtype)[:, 0].astype(exact)

    def put_numbers(self, image: Bytes, values: Values) -> None:
        """Write numbers into an image, clamped to the type's range and, for integers, rounded."""
        least, most = self.limits
        if self.dtype.kind != "f":
            values = np.rint(values)
            if self.dtype.itemsize == 8:  # a double cannot represent the limits exactly
                values = values.astype(np.longdouble)
        fitting = np.minimum(np.maximum(values, least), most).astype(self.dtype)
        if self.span is not None:
            image[self.span] = fitting.view(np.uint8)
            return
        image[self.index] = fitting.view(np.uint8).reshape(self.index.shape)

    @cached_property
    def single(self) -> Number | None:
        """The group's value; None unless it is a single number that a double can represent.

        For one number, this is faster than :meth:`numbers` and :meth:`put_numbers`, and gives the same bytes.
        """
        kind, size = self.dtype.kind, self.dtype.itemsize
        if len(self) > 1 or not (kind == "f" or (kind in "iu" and size <= 4)):
            return None
        code = next(code for code, name in _NUMPY.items() if name == f"{kind}{size}")
        order = "<" if self.dtype.newbyteorder("<") == self.dtype else ">"
        return Number(order + code, int(self.index.ravel()[0]))

    def put(self, image: Bytes, table: Bytes, choice: npt.NDArray[np.intp]) -> None:
        """Write encoded values into an image.

        Args:
            image: The image.
            table: The encoded values from which to choose, an array of shape (k, size). The encoded
                value of a bit is 0 or 1.
            choice: The row of ``table`` for each value of the group, an array of shape (n,).

        """
        if self.element.base != "BOOL":
            image[self.index] = table[choice]
            return
        on, off = self._masks(table[choice, 0] != 0)
        np.bitwise_or.at(image, self.index, on)
        np.bitwise_and.at(image, self.index, ~off)

    def _masks(self, set_bits: npt.NDArray[np.bool_]) -> tuple[Bytes, Bytes]:
        bits = (np.uint8(1) << self.shifts).astype(np.uint8)
        return np.where(set_bits, bits, np.uint8(0)), np.where(set_bits, np.uint8(0), bits)


ADD, MULTIPLY, UNIFORM, GAUSSIAN = range(4)
"""The kinds of :data:`Change`, as in ``_numbers.c``: by an amount, or by a random number times an amount."""

_Compute = Callable[[ValueGroup, Values], Values]
"""A function of a group and its present values, which returns the new values."""


def places(registers: Iterable[Register], byte_order: ByteOrder) -> list[ValueGroup]:
    """Return the single values of registers and arrays, grouped by type.

    Raises:
        ValueError: The registers have more than _MAX_ELEMENTS single values.

    """
    found: dict[ElementType, list[tuple[int, int]]] = {}
    count = 0
    for register in registers:
        count += register.count
        if count > _MAX_ELEMENTS:
            raise ValueError(f"the registers have more than {_MAX_ELEMENTS} single values; name fewer registers")
        element, into = register.element, found.setdefault(register.element, [])
        if element.base == "BOOL":
            into += [(register.offset + byte, bit) for byte, bit in bit_positions(register)]
        else:
            into += [(register.offset + flat * element.stride, 0) for flat in range(register.count)]
    groups = []
    first = 0
    for element, at in found.items():
        starts = np.array([byte for byte, _ in at], dtype=np.intp)
        shifts = np.array([bit for _, bit in at], dtype=np.uint8)
        index = starts if element.base == "BOOL" else starts[:, None] + np.arange(element.size)
        groups.append(ValueGroup(element, first, index, shifts, _number_type(element, byte_order)))
        first += len(at)
    return groups


def _number_type(element: ElementType, byte_order: ByteOrder) -> np.dtype[Any]:
    """Return the numpy type of an element in the image. Its kind is V if it is not a number."""
    plain = "" if element.base == "BOOL" else scalar_codec(element, byte_order).plain
    kind = _NUMPY.get(plain, f"V{element.size}")
    return np.dtype(("<" if byte_order == "little" else ">") + kind)


# -- operations ----------------------------------------------------------------------------------------------


class OperationContext(NamedTuple):
    """Identifies the image or write to which an operation is applied.

    ``run`` is the number of the activation. ``place`` is the number of the cycle or write within
    this activation. ``cycle`` is the number of the cycle. ``time_ns`` is the instance's clock.
    """

    run: int
    place: int
    cycle: int
    time_ns: int


class StoredImage(NamedTuple):
    """An image that an operation holds, with its cycle and instance time.

    ``role`` is the purpose of the image, as a number that only the operation knows.
    """

    role: int
    cycle: int
    time_ns: int
    image: bytes


class Operation(ABC):
    """Base class of operations. Each object belongs to one injection, and has the state of its operation."""

    exact: ClassVar[bool] = False
    """True if :meth:`apply` changes no bits but those that the injection covers."""

    def begin(self) -> None:  # noqa: B027  most operations have no state
        """Reset the operation's state at the start of an activation."""

    @abstractmethod
    def apply(self, image: Bytes, at: OperationContext) -> None:
        """Change the image in place. The caller uses only the bits that the injection covers."""

    def change(self, run: int, cycle: int) -> Change | None:  # noqa: ARG002  most operations have none
        """Return a change that does the same as :meth:`apply`, but faster; None: there is no such change.

        Only operations on a single number have it.

        Args:
            run: The number of the activation.
            cycle: The number of its first cycle.

        """
        return None

    def passed(self, image: Bytes, at: OperationContext) -> None:  # noqa: B027  most operations have no state
        """Take an image into account that the operation does not change.

        If the injection has a probability, the caller calls this instead of :meth:`apply` for each
        image that the injection leaves unchanged.
        """

    def resume(self, image: Bytes) -> None:  # noqa: B027
        """Restore the state from the last image that the source's previous process published."""

    def save(self) -> list[StoredImage]:
        """Return all images that the operation holds, for a snapshot."""
        return []

    def restore(self, images: Sequence[StoredImage]) -> None:  # noqa: B027  most operations have no state
        """Replace all images that the operation holds by those that :meth:`save` has returned."""


def _bits(image: bytes) -> Bytes:
    return np.frombuffer(image, np.uint8).copy()


class Fixed(Operation):
    """``set``: replaces the values by fixed values."""

    def __init__(self, values: Bytes) -> None:
        self._values = values

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: ARG002, D102
        image[:] = self._values


class Arithmetic(Operation):
    """``offset``, ``scale``, ``clamp``: computes a new number from each number."""

    exact = True

    def __init__(
        self, places: Sequence[ValueGroup], compute: _Compute, single: tuple[int, float] | None = None
    ) -> None:
        """Create the operation.

        Args:
            places: The values.
            compute: Computes new numbers of a group.
            single: The kind and the amount of a change that does the same with a single number; None if
                there is none.

        """
        self._places = places
        self._compute = compute
        number = places[0].single if len(places) == 1 and single is not None else None
        self._change = None if number is None or single is None else (number, *single, 0, 0, 0)

    def change(self, run: int, cycle: int) -> Change | None:  # noqa: ARG002, D102
        return self._change

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        if self._change is not None:
            change_all(image, (self._change,), at.cycle)
            return
        with np.errstate(all="ignore"):
            for group in self._places:
                group.put_numbers(image, self._compute(group, group.numbers(image)))


class Noise(Operation):
    """``noise``: adds a random number to each number."""

    exact = True

    def __init__(self, places: Sequence[ValueGroup], draw: SeededRandom, amplitude: float, *, gaussian: bool) -> None:
        self._places = places
        self._count = places[-1].first + len(places[-1])
        self._draw = draw
        self._amplitude = amplitude
        self._gaussian = gaussian
        self._number = places[0].single if self._count == 1 else None

    def change(self, run: int, cycle: int) -> Change | None:  # noqa: D102
        if self._number is None:
            return None
        return self._number, GAUSSIAN if self._gaussian else UNIFORM, self._amplitude, self._draw.key, run, cycle

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        change = self.change(at.run, at.cycle - at.place)
        if change is not None:
            change_all(image, (change,), at.cycle)
            return
        count = self._count
        if self._gaussian:
            noise = self._draw.gaussian(at.run, at.place, count) * self._amplitude
        else:
            noise = (2 * self._draw.uniform(at.run, at.place, count) - 1) * self._amplitude
        with np.errstate(all="ignore"):
            for group in self._places:
                own = noise[group.first : group.first + len(group)]
                group.put_numbers(image, group.numbers(image) + own)


class RandomRange(Operation):
    """``random`` with a range: replaces each number by a random number.

    Both ends of a range of integers are included.
    """

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
    """``random`` with a list: replaces each value by a random value of the list."""

    def __init__(self, tables: Sequence[tuple[ValueGroup, Bytes]], draw: SeededRandom) -> None:
        """Create the operation.

        ``tables`` has each group with the values to choose from, an array of shape (k, size).
        """
        self._tables = tables
        self._draw = draw

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        last = self._tables[-1][0]
        choice = self._draw.below(len(self._tables[0][1]), at.run, at.place, last.first + len(last))
        for group, table in self._tables:
            group.put(image, table, choice[group.first : group.first + len(group)])


class Freeze(Operation):
    """``freeze``: consumers see the first values of the activation until it ends."""

    def __init__(self) -> None:
        self._held: Bytes | None = None

    def begin(self) -> None:
        """Forget the frozen values, so that the values of the next image are frozen."""
        self._held = None

    def resume(self, image: Bytes) -> None:
        """Freeze the values that the source's previous process published last."""
        self._held = image.copy()

    def save(self) -> list[StoredImage]:
        """Return the frozen values."""
        return [] if self._held is None else [StoredImage(0, 0, 0, self._held.tobytes())]

    def restore(self, images: Sequence[StoredImage]) -> None:
        """Freeze the values in a snapshot."""
        self._held = next((_bits(one.image) for one in images), None)

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: ARG002, D102
        if self._held is None:
            self._held = image.copy()
        image[:] = self._held


class Drop(Operation):
    """``drop`` over ``/out``: drops the values of some cycles, in which readers see the previous values.

    The caller calls :meth:`apply` for the cycles to drop, and :meth:`passed` for all other cycles.
    """

    def __init__(self) -> None:
        self._held: Bytes | None = None
        self._passing: tuple[int, Bytes] | None = None

    def begin(self) -> None:
        """Forget all values.

        Even if the next cycle is dropped, readers see its values, because there are no earlier
        values.
        """
        self._held = self._passing = None

    def resume(self, image: Bytes) -> None:
        """Restore the values that readers saw last."""
        self._held = image.copy()

    def save(self) -> list[StoredImage]:
        """Return the values that readers see in a dropped cycle, and the values of the last cycle not dropped."""
        held = [] if self._held is None else [StoredImage(0, 0, 0, self._held.tobytes())]
        passing = [] if self._passing is None else [StoredImage(1, self._passing[0], 0, self._passing[1].tobytes())]
        return held + passing

    def restore(self, images: Sequence[StoredImage]) -> None:
        """Restore the values in a snapshot."""
        self._held = next((_bits(one.image) for one in images if not one.role), None)
        self._passing = next(((one.cycle, _bits(one.image)) for one in images if one.role), None)

    def passed(self, image: Bytes, at: OperationContext) -> None:
        """Store the values of a cycle that is not dropped."""
        self._settle(at.cycle)
        self._passing = at.cycle, image.copy()

    def apply(self, image: Bytes, at: OperationContext) -> None:  # noqa: D102
        self._settle(at.cycle)
        if self._held is None:
            self._held = image.copy()
        image[:] = self._held

    def _settle(self, cycle: int) -> None:
        """Store the last image of an earlier cycle, which readers see if this cycle is dropped."""
        if self._passing is not None and self._passing[0] != cycle:
            self._held, self._passing = self._passing[1], None


class Delay(Operation):
    """``delay`` over ``/out``: readers see values that are some time or some cycles old.

    While the activation has lasted less than the delay, readers see its first values.
    """

    def __init__(self, size: int, delay_ns: int, cycles: int) -> None:
        """Create the delay.

        Args:
            size: Size of an image in bytes.
            delay_ns: The delay in ns; 0 if the delay is given in cycles.
            cycles: The delay in cycles; 0 if the delay is given in ns.

        """
        self.delay_ns = delay_ns
        self.cycles = cycles
        self._most = max(2, MAX_DELAY_BYTES // max(1, size))
        self._line: deque[tuple[int, int, Bytes]] = deque()

    def begin(self) -> None:
        """Forget all stored images."""
        self._line.clear()

    def save(self) -> list[StoredImage]:
        """Return all stored images, the oldest first."""
        return [StoredImage(0, cycle, time_ns, image.tobytes()) for cycle, time_ns, image in self._line]

    def restore(self, images: Sequence[StoredImage]) -> None:
        """Store the images in a snapshot, instead of all others."""
        self._line = deque((one.cycle, one.time_ns, _bits(one.image)) for one in images)

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
        """Return whether an image of this cycle and time is old enough to be seen in the cycle ``at``."""
        return at.cycle - cycle >= self.cycles if self.cycles else at.time_ns - time_ns >= self.delay_ns


class Flip(Operation):
    """``flip``: inverts given bits, or a random bit among those that the injection covers."""

    def __init__(self, mask: Bytes | None, cover: Bytes, draw: SeededRandom) -> None:
        """Create the operation.

        Args:
            mask: An image in which the bits to invert are set, of shape (size,). If None, one random
                covered bit is inverted in each cycle.
            cover: An image in which the bits that the injection covers are set, of shape (size,).
            draw: The source of randomness.

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
