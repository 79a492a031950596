"""Quality and provenance of values, with the numbers that segment and wire use."""

from __future__ import annotations

from enum import IntEnum


class Quality(IntEnum):
    """Quality of a value, as in OPC UA (OPC 10000-8, section 6.3). Zeroed memory is bad."""

    BAD = 0
    UNCERTAIN = 1
    GOOD = 2

    def __str__(self) -> str:
        return self.name.lower()


class Provenance(IntEnum):
    """Origin of a value."""

    LIVE = 0
    SIMULATED = 1
    REPLAYED = 2
    INJECTED = 3

    def __str__(self) -> str:
        return self.name.lower()


class Column(IntEnum):
    """The array that holds the values of a type, numbered as the fields of ``Values`` in shmio.v1."""

    BOOL = 1
    INT32 = 2
    INT64 = 3
    UINT64 = 4
    FLOAT = 5
    DOUBLE = 6
    TEXT = 7
