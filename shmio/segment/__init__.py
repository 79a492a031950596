"""The shared-memory segment of an instance: header, process table, and a block for each source.

A block contains the frames, events and commands of its source. docs/reference/segment-format.md
describes the bytes. Local programs use a segment through :func:`shmio.attach`.
"""

from shmio.layout.values.write import Write
from shmio.model.values import Provenance, Quality
from shmio.segment.block import (
    Attributes,
    Block,
    BlockWriter,
    Cursor,
    Frame,
    FrameFollower,
    QualityChange,
    Stamp,
)
from shmio.segment.commands import Command, CommandKind, Direction
from shmio.segment.events import DONE, ENDS, Event, EventKind, Record
from shmio.segment.header import State
from shmio.segment.processes import Activity, Phase, ProcessSlot, ProcessSpec, Report, Supervised
from shmio.segment.segment import PREFIX, BlockSpec, Origin, Segment, instances, running_instances, segment_size

__all__ = [
    "DONE",
    "ENDS",
    "PREFIX",
    "Activity",
    "Attributes",
    "Block",
    "BlockSpec",
    "BlockWriter",
    "Command",
    "CommandKind",
    "Cursor",
    "Direction",
    "Event",
    "EventKind",
    "Frame",
    "FrameFollower",
    "Origin",
    "Phase",
    "ProcessSlot",
    "ProcessSpec",
    "Provenance",
    "Quality",
    "QualityChange",
    "Record",
    "Report",
    "Segment",
    "Stamp",
    "State",
    "Supervised",
    "Write",
    "instances",
    "running_instances",
    "segment_size",
]
