"""Test suite for connectors whose registers have addresses in a tag table. It needs pytest.

It checks that every type passes in both directions without a change, that a wrong address makes
only its own register bad, and that a table may have more registers than one request.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final, Protocol

import pytest

from shmio.connectors.base import Connector
from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import Write, encode
from shmio.model.statuses import GOOD, StatusArea
from shmio.testing.conformance import PATIENCE_S
from shmio.testing.write_conformance import write

VALUES: Final[Mapping[str, tuple[Value, Value]]] = {
    "BOOL": (True, False), "SINT": (-128, 127), "INT": (-32_768, 32_767), "DINT": (-(1 << 31), (1 << 31) - 1),
    "LINT": (-(1 << 63), (1 << 63) - 1), "USINT": (0, 255), "UINT": (0, 65_535), "UDINT": (0, (1 << 32) - 1),
    "ULINT": (0, (1 << 64) - 1), "BYTE": (0x80, 0xFF), "WORD": (0x8001, 0xFFFF), "DWORD": (0x8000_0001, 0xFFFF_FFFF),
    "LWORD": ((1 << 63) + 1, (1 << 64) - 1), "REAL": (-3.4028234663852886e38, 1.401298464324817e-45),
    "LREAL": (-1.7976931348623157e308, 5e-324), "STRING": ("x", "Grüße 1"), "TIME": (-(1 << 31), (1 << 31) - 1),
}  # fmt: skip
"""The two ends of each type's range."""

Tags = Mapping[str, Mapping[str, object]]


class TableRig(Protocol):
    """A device whose values only the tests change."""

    @property
    def types(self) -> Tags:
        """Writable tags: one of each type that the connector supports, and arrays."""

    @property
    def unknown(self) -> Mapping[str, object]:
        """A tag with an address that the device does not have."""

    @property
    def many(self) -> Tags:
        """More writable tags of the type INT than one request can read."""

    def connector(self, layout: Layout) -> Connector:
        """Return a new connector for a tag table."""


class Source:
    """A connected connector, with the layout that decodes its images."""

    def __init__(self, connector: Connector, layout: Layout) -> None:
        self.connector, self.layout = connector, layout
        self._area = StatusArea(layout)

    def write(self, values: Mapping[str, Value]) -> Sequence[str]:
        """Write all values in one batch; return an outcome for each write."""
        writes: list[Write] = []
        for path, value in values.items():
            writes += encode(self.layout.registers[self.layout.by_path[path]], value, self.layout.byte_order)
        return write(self.connector, writes)

    def until(self, values: Mapping[str, Value], codes: Mapping[str, int]) -> None:
        """Read until registers have these values and status codes."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            image = self.connector.read()
            found = {path: self._value(path, image) for path in values}
            stated = {path: self._area.get(image, self.layout.by_path[path]).code for path in codes}
            if found == values and stated == codes:
                return
            if time.monotonic() > deadline_s:
                assert (found, stated) == (values, codes)

    def codes(self) -> dict[str, int]:
        """Return the status code of each register."""
        image = self.connector.read()
        return {one.path: self._area.get(image, index).code for index, one in enumerate(self.layout.registers)}

    def _value(self, path: str, image: bytes) -> Value:
        return codec(self.layout.registers[self.layout.by_path[path]], self.layout.byte_order).decode(image)


@contextmanager
def connected(rig: TableRig, tags: Tags) -> Iterator[Source]:
    """Connect to the device with a tag table."""
    layout = place_tags("device", tags).with_statuses()
    connector = rig.connector(layout)
    try:
        connector.connect()
        yield Source(connector, layout)
    finally:
        connector.close()


def value_of(tag: Mapping[str, object], which: int) -> Value:
    """Return one of the two ``VALUES`` of a tag's type: the first (``which`` is 0) or the second (1).

    In an array, the elements alternate between both values, beginning with this one.
    """
    kind = str(tag["type"])
    base = kind.rpartition(" OF ")[2].partition("[")[0]
    if not kind.startswith("ARRAY[1.."):
        return VALUES[base][which]
    return [VALUES[base][(which + place) % 2] for place in range(int(kind[9:].partition("]")[0]))]


class TableConformance:
    """Tests of tag tables. Inherit from this class, and define a fixture ``table``: a :class:`TableRig`."""

    @pytest.mark.parametrize("which", [0, 1])
    def test_every_type_in_both_directions(self, table: TableRig, which: int) -> None:
        """The values at the ends of a type's range are written and read without a change."""
        with connected(table, table.types) as source:
            for turn in (1 - which, which):
                values = {path: value_of(tag, turn) for path, tag in table.types.items()}
                outcomes = source.write(values)
                assert not any(outcomes), [one for one in outcomes if one]
            source.until(values, dict.fromkeys(values, GOOD))

    def test_one_bad_address_among_good_ones(self, table: TableRig) -> None:
        """An address that the device does not have makes only its own register bad."""
        with connected(table, {**table.types, "unknown": table.unknown}) as source:
            values = {path: value_of(tag, 0) for path, tag in table.types.items()}
            assert not any(source.write(values))
            source.until(values, dict.fromkeys(values, GOOD))
            for _ in range(5):
                codes = source.codes()
                assert codes.pop("unknown") >> 31, "the register without an address is not bad"
                assert set(codes.values()) == {GOOD}

    def test_more_registers_than_one_request_holds(self, table: TableRig) -> None:
        """Each register has its own value."""
        with connected(table, table.many) as source:
            values: dict[str, Value] = {path: at + 1 for at, path in enumerate(table.many)}
            assert not any(source.write(values))
            source.until(values, dict.fromkeys(values, GOOD))
            values = {path: -number for path, number in values.items() if isinstance(number, int)}
            assert not any(source.write(values))
            source.until(values, dict.fromkeys(values, GOOD))

    def test_a_write_after_close_raises_connector_error(self, table: TableRig) -> None:
        """A closed connector refuses a write with ConnectorError."""
        path, tag = next(iter(table.types.items()))
        with connected(table, table.types) as source:
            source.connector.close()
            with pytest.raises(ConnectorError):
                source.write({path: value_of(tag, 1)})
