"""Merges the addresses of a block into as few requests as a device's limits allow."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

from shmio.layout.addresses.modbus import Table


class Element(NamedTuple):
    """One element of a register: what must be read in one request.

    Attributes:
        unit: Unit id.
        table: The table.
        start: First entry in the table.
        size: Number of entries, bits or words.
        register: Index of the register in the layout.
        place: Place of the element in the register, 0 for a scalar.

    """

    unit: int
    table: Table
    start: int
    size: int
    register: int
    place: int


@dataclass(frozen=True, eq=False)
class ReadRequest:
    """A request that reads consecutive entries of a table, with the elements that lie in them."""

    unit: int
    table: Table
    start: int
    count: int
    elements: tuple[Element, ...]

    def halves(self) -> list[ReadRequest]:
        """Return two requests that together read the same elements; only itself if it has but one address."""
        addresses = sorted({(one.start, one.size) for one in self.elements})
        if len(addresses) == 1:
            return [self]
        middle = addresses[len(addresses) // 2]
        parts = (
            [one for one in self.elements if (one.start, one.size) < middle],
            [one for one in self.elements if (one.start, one.size) >= middle],
        )
        return [_request(part) for part in parts]


class Limits(NamedTuple):
    """What one request may read."""

    words: int
    bits: int
    gap: int
    """Most unused entries between two elements of a request."""


def plan(elements: Iterable[Element], limits: Limits) -> list[ReadRequest]:
    """Return requests that read all elements, none of them in two parts.

    Raises:
        ValueError: An element is longer than a request may be.

    """
    requests: list[ReadRequest] = []
    ordered = sorted(elements, key=lambda one: (one.unit, one.table.value, one.start, one.size))
    for (_, table), group in groupby(ordered, key=lambda one: (one.unit, one.table)):
        most = limits.bits if table.of_bits else limits.words
        part: list[Element] = []
        end = 0
        for one in group:
            if one.size > most:
                raise ValueError(f"{table.value} {one.start}: {one.size} words, but a request reads at most {most}")
            stop = max(end, one.start + one.size)
            if part and (one.start - end > limits.gap or stop - part[0].start > most):
                requests.append(_request(part))
                part, stop = [], one.start + one.size
            part.append(one)
            end = stop
        requests.append(_request(part))
    return requests


def _request(elements: Sequence[Element]) -> ReadRequest:
    first = elements[0]
    start = min(one.start for one in elements)
    stop = max(one.start + one.size for one in elements)
    return ReadRequest(first.unit, first.table, start, stop - start, tuple(elements))
