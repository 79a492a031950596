"""``shmio-supervisor check``: validate a configuration and the files it names; start nothing."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from typing import Any

from shmio.cli.run import dumps
from shmio.cli.target import config_file
from shmio.errors import ShmioError
from shmio.logs import printable
from shmio.plan.ports import taken
from shmio.plan.prepare import peer, prepare
from shmio.plan.processes import Plan
from shmio.segment import PREFIX, BlockSpec, Segment


def execute(arguments: argparse.Namespace) -> int:
    """Print what the instance would need: processes, registers and memory."""
    file = config_file(arguments)
    prepared = prepare(file)
    plan = prepared.plan
    found: dict[str, Any] = {
        "config": str(file),
        "instance": plan.instance,
        "processes": [job.name for job in plan.jobs],
        "sources": [
            _described(block, peer(source)) for source, block in zip(prepared.config.source, plan.blocks, strict=True)
        ],
        "injections": list(prepared.injections),
        "replay": [],
        "segment": f"{PREFIX}{plan.instance}",
        "segment_bytes": plan.segment_bytes,
        "notes": [*prepared.notes, *_taken(file, plan)],
        "warnings": list(plan.warnings),
    }
    if prepared.config.replay and prepared.config.replay.file:
        replay = prepare(file, "replay").plan
        found["replay"] = [_described(block, "") for block in replay.blocks]
        found["warnings"] += [warning for warning in replay.warnings if warning not in plan.warnings]
    print(dumps(found, indent=2) if arguments.json else "\n".join(map(printable, _lines(found))))
    return 0


def _taken(file: Path, plan: Plan) -> list[str]:
    """Return a note for each address that another program uses; none if the instance runs."""
    with suppress(ShmioError), Segment.open(plan.instance, config=file) as segment:
        if segment.supervised:
            return []
    return [f"note: up would fail at present: {problem}" for problem in taken(plan)]


def _lines(found: dict[str, Any]) -> list[str]:
    count, processes = len(found["warnings"]), len(found["processes"])
    return [
        f"{found['config']}: instance {found['instance']}, {processes} process{'es' * (processes != 1)}",
        *(f"  {_line(source)}" for source in found["sources"]),
        *(f"  {text}" for text in found["injections"]),
        *(f"  with --mode replay: {_line(source)}" for source in found["replay"]),
        f"  segment {found['segment']}: {found['segment_bytes'] / 1e6:.2f} MB of shared memory",
        *found["notes"],
        *found["warnings"],
        f"usable, with {count} warning{'s' * (count != 1)}" if count else "no faults found",
    ]


def _described(block: BlockSpec, peer: str) -> dict[str, Any]:
    return {
        "source": block.source,
        "peer": peer or None,
        "block": block.layout.name,
        "registers": len(block.layout.registers),
        "bytes": block.layout.size,
        "ring_frames": block.slots,
        "ring_s": block.slots * block.period_ns / 1e9,
        "ring_bytes": block.size,
    }


def _line(source: dict[str, Any]) -> str:
    at = f" at {source['peer']}" if source["peer"] else ""
    return (
        f"source {source['source']}{at}: {source['block']}, {source['registers']} registers, {source['bytes']} bytes; "
        f"ring of {source['ring_frames']} frames, {source['ring_s']:.1f} s, {source['ring_bytes'] / 1e6:.2f} MB"
    )
