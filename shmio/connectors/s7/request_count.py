"""Counts the requests of a cycle, for each PDU size that a controller may grant."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import Final

from shmio.connectors.request_count import Requests

PDU_SIZES: Final = (240, 480, 960)
"""The usual PDU sizes in bytes: S7-300 and S7-1200 mostly grant 240, S7-400 480, S7-1500 960."""
NOTE: Final = (
    "this assumes one request at a time; many controllers accept more, and the log of the source shows how many the "
    "controller has granted (jobs=, and pdu= for the size)"
)


def by_pdu_size(count: Callable[[int], int]) -> tuple[Requests, ...]:
    """Return the number of requests in a cycle for each usual PDU size. Sizes with equal numbers share an entry.

    Args:
        count: Returns the number of requests for a PDU size.

    """
    counted = [(count(size), size) for size in PDU_SIZES]
    found = [(number, [size for _, size in group]) for number, group in groupby(counted, key=lambda one: one[0])]
    if len(found) == 1:
        return (Requests(found[0][0]),)
    return tuple(Requests(number, assumption=f"PDU of {' or '.join(map(str, sizes))} bytes") for number, sizes in found)
