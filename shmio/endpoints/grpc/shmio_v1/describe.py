"""Messages that describe layouts, injections and the instance's status."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from shmio.config import Declaration
from shmio.endpoints.grpc.shmio_v1.clock import clock
from shmio.endpoints.grpc.shmio_v1.views import describe
from shmio.local.status import ProcessStatus, SourceStatus, status_of
from shmio.messages import declaration_to_wire
from shmio.model.injection import Running
from shmio.segment import Block, Segment
from shmio.segment.standing_injections import StandingInjection
from shmio.wire import shmio_v1_pb2 as wire

PART_REGISTERS = 4096
"""Bound of the registers in one message."""
_REMEDY = "shmio-supervisor up takes them over, shmio-supervisor down stops them"


def layout_parts(block: Block) -> Iterator[wire.LayoutPart]:
    """Yield a block's layout in as many messages as necessary."""
    layout, attributes = block.layout, block.attributes
    for first in range(0, max(1, len(layout.registers)), PART_REGISTERS):
        part = wire.LayoutPart(
            source=block.source,
            section=block.section,
            name=layout.name,
            number=layout.number,
            size=layout.size,
            big_endian=layout.byte_order == "big",
            hash=layout.hash,
            period_ns=block.period_ns,
            stale_ns=block.stale_ns,
            writable=attributes.writable,
            armed=attributes.armed,
            optimized=layout.optimized,
            last=first + PART_REGISTERS >= len(layout.registers),
        )
        for register in layout.registers[first : first + PART_REGISTERS]:
            found = part.registers.add()
            describe(register, found)
            found.comment = register.comment
            if register.initial is not None:
                found.initial = register.initial
        yield part


def injection(block: Block, one: StandingInjection) -> wire.Injection:
    """Describe an injection that stands on a block."""
    return wire.Injection(
        source=block.source,
        number=one.number,
        direction=wire.DIRECTION_IN if one.direction == "in" else wire.DIRECTION_OUT,
        priority=one.priority,
        keep=one.keep,
        name=one.name,
        pid=one.pid,
        writer=one.writer,
        ranges=[wire.Range(offset=offset, size=size, mask=mask) for offset, size, mask in one.ranges],
        running=None if one.running is None else _running(one.running),
    )


def _running(running: Running[Declaration]) -> wire.Running:
    """Describe the state of a declared injection."""
    declaration = running.declaration
    return wire.Running(
        declaration=declaration_to_wire(msgspec.to_builtins(declaration), declaration.name),
        state=f"STATE_{running.state.upper()}",
        seed=running.seed,
        runs=running.runs,
        cycle=running.cycle,
        time_ns=running.time_ns,
    )


def status(segment: Segment) -> wire.Status:
    """Describe the instance's status."""
    now = status_of(segment, _REMEDY, asking="grpc")
    found = wire.Status(
        instance=now.instance or "",
        mode=now.mode or "",
        state=now.state,
        segment=now.segment or "",
        segment_bytes=now.segment_bytes,
        processes=map(_process, now.processes),
        note=now.note,
        clock=clock(segment.clock.read()),
    )
    if now.supervisor is not None:
        found.supervisor.pid, found.supervisor.uptime_s = now.supervisor.pid, now.supervisor.uptime_s
    return found


def _process(process: SourceStatus | ProcessStatus) -> wire.Process:
    found = wire.Process(
        name=process.name,
        kind=process.kind,
        pid=process.pid,
        state=process.state,
        restarts=process.restarts,
        uptime_s=process.uptime_s,
        note=process.note,
        counters=process.counters,
    )
    if isinstance(process, SourceStatus):
        found.source.quality, found.source.reason = process.quality, process.reason
        found.source.rate_hz, found.source.overruns = process.rate_hz, process.overruns
        found.source.real_time = process.real_time
        if process.cycle is not None:
            found.source.cycle = process.cycle
    return found
