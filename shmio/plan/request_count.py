"""Counts the requests and the writable registers of the sources in a checked configuration."""

from __future__ import annotations

from shmio.config import Source
from shmio.connectors import registry
from shmio.connectors.base import Connector
from shmio.connectors.request_count import CycleRequests
from shmio.layout.model import Layout
from shmio.layout.values.write import bits_of, cover


def source_requests(source: Source, layout: Layout) -> CycleRequests | None:
    """Return what a source requests from its device in each cycle.

    Return None if the source has no device, or if its connector does not count requests.

    Args:
        source: A checked source.
        layout: The layout of the source's block.

    """
    connector = registry.load(source.connector)
    if not issubclass(connector, Connector):
        return None
    made = connector.for_layout(layout)(registry.convert_options(source.connector, source.options), layout.base)
    try:
        return made.cycle_requests()
    finally:
        made.close()


def can_write(source: Source, layout: Layout) -> bool:
    """Return whether the connector of a checked source can write."""
    connector = registry.load(source.connector)
    return not issubclass(connector, Connector) or connector.for_layout(layout).can_write


def writable_registers(source: Source, layout: Layout) -> int:
    """Return the number of a checked source's registers that commands can write, at least in part."""
    if not source.writable or not can_write(source, layout):
        return 0
    mask = cover(layout, source.writable)
    return sum(
        any(mask[at] & bits for at, bits in enumerate(bits_of(register), register.offset))
        for register in layout.registers
    )
