"""The shared-memory segment of an instance: header, process table, one frame ring for each source.

The byte format is docs/reference/segment-format.md; a local program starts with :func:`shmio.attach`.
"""

from shmio.segment.block import Block, BlockWriter, Cursor
from shmio.segment.frame import Frame, Provenance, Quality
from shmio.segment.header import State
from shmio.segment.processes import Activity, Phase, ProcessSlot, ProcessSpec, Report, Supervised
from shmio.segment.segment import PREFIX, BlockSpec, Segment, instances, running_instances, segment_size

__all__ = [
    "PREFIX",
    "Activity",
    "Block",
    "BlockSpec",
    "BlockWriter",
    "Cursor",
    "Frame",
    "Phase",
    "ProcessSlot",
    "ProcessSpec",
    "Provenance",
    "Quality",
    "Report",
    "Segment",
    "State",
    "Supervised",
    "instances",
    "running_instances",
    "segment_size",
]
