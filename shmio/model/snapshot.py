"""Snapshots: what programs learn of one, and the decoding of its parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import msgspec

from shmio.errors import SnapshotError

Part = TypeVar("Part")


class SnapshotInfo(msgspec.Struct, frozen=True):
    """A saved state of an instance.

    Attributes:
        name: Name of the snapshot.
        instance: Name of the instance that was saved.
        saved_s: UTC at which it was saved, in s since 1970.
        time_ns: The instance's clock, in ns.
        step: Number of the last step.
        size_bytes: Size of the file.
        left_out: For each process that is not in the snapshot, the reason. Empty if nothing is missing.
        problem: Why the snapshot cannot be read; only ``name`` is valid then. Empty if it can be read.
    """

    name: str
    instance: str = ""
    saved_s: float = 0.0
    time_ns: int = 0
    step: int = 0
    size_bytes: int = 0
    left_out: Mapping[str, str] = msgspec.field(default_factory=dict)
    problem: str = ""


def decode_part(data: bytes, kind: type[Part], what: str = "its state") -> Part:
    """Decode a part of a snapshot, which is MessagePack.

    Args:
        data: The encoded part.
        kind: The type of the part.
        what: The part, as the message names it.

    Raises:
        SnapshotError: The data do not have this type.

    """
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SnapshotError(f"{what} is damaged: {error}") from None
