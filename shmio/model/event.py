"""Events of a source: commands and outcomes, injections, quality, starts and stops, notes."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import msgspec

from shmio.model.values import Quality, pid_of


class EventKind(StrEnum):
    """Kind of an event."""

    STARTED = "started"
    """The source's process has started."""
    STOPPED = "stopped"
    """The source's process has stopped."""
    QUALITY = "quality"
    """The quality of the source's values has changed."""
    ACCEPTED = "accepted"
    """The source accepted an item of a command; an event with the outcome follows."""
    REJECTED = "rejected"
    """The source rejected the whole command before it did anything."""
    WRITTEN = "written"
    """The device confirmed the write."""
    REFUSED = "refused"
    """The device refused the write."""
    EXPIRED = "expired"
    """The write was not sent to the device, and will not be."""
    UNKNOWN = "unknown"
    """The write was sent, but no answer came."""
    DIVERTED = "diverted"
    """An injection took these values, which came from a writer or from an inner injection."""
    TAKEN = "taken"
    """Injections took all values of the item, so that the device got none of them."""
    INJECTED = "injected"
    """An injection was created."""
    LIFTED = "lifted"
    """An injection was lifted."""
    SHADOWED = "shadowed"
    """A program gave values to an injection, and consumers see them."""
    ACTIVATED = "activated"
    """A declared injection became active."""
    DEACTIVATED = "deactivated"
    """A declared injection is no longer active."""
    NOTED = "noted"
    """A program added a note."""
    SAVED = "saved"
    """The state of the source was saved in a snapshot; the event's text is the snapshot's name."""
    RESTORED = "restored"
    """The state of the source was restored from a snapshot; time may have gone back.

    The event's text is the snapshot's name.
    """
    REMOVED = "removed"
    """A reload has removed the source; no more events follow."""
    OTHER = "other"
    """The event has a kind that only a later version of shmio knows."""


class Event(msgspec.Struct, frozen=True):
    """An event of a source.

    A write of more than 256 bytes causes several events, one for each part.

    Attributes:
        source: Name of the source.
        kind: Kind of the event.
        number: Number of the event; 0 with ``removed``. The numbers of a source's events ascend
            until a reload replaces the source.
        frame: Number of the last frame before the event.
        cycle: Cycle of the source's schedule.
        incarnation: Number of times that the source's process has been started, including the
            present start.
        clock_ns: The instance's clock, in ns.
        utc_ns: UTC time, in ns.
        quality: Quality after the event.
        text: A reason, the note, or the name of the injection or snapshot, depending on the kind.
        injection: Number of the injection that the event is about; 0: none.
        command: Number of the command that the event is about, chosen by its writer; 0: none.
        by: The client that caused the event, as the audit log names it, such as ``web: anonymous
            (127.0.0.1)`` or ``local: uid 1000 (pid 4711 python3)``. A local program states this
            itself. If it has not: ``grpc``, ``mqtt``, or a program such as ``program 1``. Empty if
            no client caused the event, or if the client is unknown.
        direction: ``in`` if the event is about data for the device, ``out`` if it is about data for
            consumers. Empty if it is about no registers, or if the direction is unknown.
        paths: The registers, elements, slices or bits that the event is about, at most 2048. If a
            command has several items, ``rejected`` and ``taken`` have only the paths of the first
            item. So do other outcomes if the event ``accepted`` was missed.
        values: Values by path; only with ``accepted``, ``diverted`` and ``shadowed``. None stands
            for bytes that are not valid for their type.
        missed: Number of the source's events lost since the previous event.
    """

    source: str
    kind: EventKind
    number: int
    frame: int
    cycle: int
    incarnation: int
    clock_ns: int
    utc_ns: int
    quality: Quality
    text: str = ""
    injection: int = 0
    command: int = 0
    by: str = ""
    direction: str = ""
    paths: tuple[str, ...] = ()
    values: Mapping[str, Any] = msgspec.field(default_factory=dict)
    missed: int = 0

    @property
    def sender(self) -> str:
        """The program that caused the event, as messages name it; on the instance's host, by its pid."""
        if self.by == "fabric":
            return "a program of another cell, which shmio-supervisor audit names"
        pid = pid_of(self.command) if self.by.startswith(("program ", "local: ")) else 0
        return f"pid {pid}" if pid else self.by
