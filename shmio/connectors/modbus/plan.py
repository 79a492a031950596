"""Merges the addresses of a block into as few requests as a device's limits allow."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Final, NamedTuple

from shmio.layout.addresses.modbus import Table


class Element(NamedTuple):
    """One element of a register, which must be read in one request.

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
    """A request that reads consecutive entries of a table, and the elements in these entries."""

    unit: int
    table: Table
    start: int
    count: int
    elements: tuple[Element, ...]

    def halves(self) -> list[ReadRequest]:
        """Return two requests that together read the same elements; only this one if it has just one address."""
        addresses = sorted({(one.start, one.size) for one in self.elements})
        if len(addresses) == 1:
            return [self]
        middle = addresses[len(addresses) // 2]
        parts = (
            [one for one in self.elements if (one.start, one.size) < middle],
            [one for one in self.elements if (one.start, one.size) >= middle],
        )
        return [_request(part) for part in parts]


RETRY_NS: Final = 10_000_000_000
"""Pause before a refused address is tried again."""
MAX_PROBES: Final = 20
"""Maximum number of additional requests in a cycle that search for refused addresses or try them again."""
Place = tuple[int, Table, int]
"""An entry of a device: unit id, table, and number in the table."""


class Limits(NamedTuple):
    """Limits of a read request. ``words`` and ``bits`` are the maximum numbers of words and of bits in a request."""

    words: int
    bits: int
    gap: int
    """Maximum number of unused entries between two elements of a request."""


def plan(elements: Iterable[Element], limits: Limits, refused: Collection[Place] = ()) -> list[ReadRequest]:
    """Return requests that together read all elements. No element is divided between two requests.

    Args:
        elements: The elements.
        limits: Limits of a request.
        refused: Places that the device refuses. No request includes them.

    Raises:
        ValueError: An element is longer than a request may be.

    """
    requests: list[ReadRequest] = []
    ordered = sorted(elements, key=lambda one: (one.unit, one.table.value, one.start, one.size))
    for key, group in groupby(ordered, key=lambda one: (one.unit, one.table)):
        table = key[1]
        most = limits.bits if table.of_bits else limits.words
        part: list[Element] = []
        end = 0
        for one in group:
            if one.size > most:
                raise ValueError(
                    f"{table.value} {one.start} takes {one.size} words, but a request reads at most {most}"
                )
            stop = max(end, one.start + one.size)
            over = any((*key, address) in refused for address in range(end, one.start)) if refused and part else False
            if part and (over or one.start - end > limits.gap or stop - part[0].start > most):
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


@dataclass
class Refusals:
    """Plans requests without the addresses that a device refuses, and remembers these across connections."""

    elements: Sequence[Element]
    limits: Limits
    requests: list[ReadRequest] = field(init=False)
    """The requests of a cycle, without refused addresses."""
    refused: dict[Element, tuple[int, int]] = field(default_factory=dict)
    """The refused elements, each with the time to try it again (ns of CLOCK_MONOTONIC) and its status."""
    suspects: dict[ReadRequest, int] = field(default_factory=dict)
    """Halves of refused requests that have not been answered yet, each with the status of the refusal."""

    def __post_init__(self) -> None:
        self.requests = plan(self.elements, self.limits)

    def split(self, request: ReadRequest, status: int) -> list[ReadRequest]:
        """Replace a refused request by its two halves, and return them.

        If the request has only one address, return the request itself.
        """
        halves = request.halves()
        self.suspects.pop(request, None)
        if len(halves) > 1:
            self.suspects |= dict.fromkeys(halves, status)
            place = self.requests.index(request)
            self.requests[place : place + 1] = halves
        return halves

    def refuse(self, request: ReadRequest, status: int, now_ns: int) -> bool:
        """Exclude the only address of a request for ``RETRY_NS``.

        Return True if the address was not refused before.
        """
        first = request.elements[0] not in self.refused
        self.refused.update((one, (now_ns + RETRY_NS, status)) for one in request.elements)
        if request in self.requests:
            self.requests.remove(request)
        return first

    def due(self, now_ns: int, most: int) -> list[ReadRequest]:
        """Return requests for refused addresses whose pause is over, at most ``most`` requests."""
        found: dict[tuple[Place, int], list[Element]] = {}
        for one, (retry_ns, _) in self.refused.items():
            if retry_ns <= now_ns:
                found.setdefault(((one.unit, one.table, one.start), one.size), []).append(one)
        return [_request(some) for some in list(found.values())[: max(0, most)]]

    def accept(self, request: ReadRequest) -> None:
        """Treat the addresses of a request as no longer refused, because the device has answered the request.

        From now on, these addresses are read together with others again.
        """
        for one in request.elements:
            self.refused.pop(one, None)
        refused = {
            (one.unit, one.table, address) for one in self.refused for address in range(one.start, one.start + one.size)
        }
        self.suspects.clear()
        self.requests = plan((one for one in self.elements if one not in self.refused), self.limits, refused)
