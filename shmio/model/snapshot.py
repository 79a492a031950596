"""Snapshots: a description for programs, and the decoding of their parts."""

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
        saved_s: UTC at which the snapshot was saved, in s since 1970.
        time_ns: The instance's clock at that time, in ns.
        step: Number of the last step at that time.
        size_bytes: Size of the snapshot's file.
        left_out: For each process whose state is not in the snapshot, the reason; empty if no process
            is missing.
        problem: Why the snapshot cannot be read; then only ``name`` is valid. Empty if it can be read.
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
        what: The name of the part, for the message.

    Raises:
        SnapshotError: The data do not have this type.

    """
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SnapshotError(f"{what} is damaged: {error}") from None
