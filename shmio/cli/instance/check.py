"""``shmio-supervisor check``: validate a configuration and the files it names; start nothing."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from typing import Any

from shmio.cli.run import dumps
from shmio.cli.target import config_file
from shmio.config import Address
from shmio.errors import ConfigError, ShmioError
from shmio.logs import printable
from shmio.plan.ports import served, taken
from shmio.plan.prepare import Prepared, peer, prepare
from shmio.plan.processes import Plan
from shmio.segment import PREFIX, BlockSpec, Segment


def check(arguments: argparse.Namespace) -> int:
    """Print what the instance would need: processes, registers and memory."""
    file = config_file(arguments)
    prepared = prepare(file)
    plan = prepared.plan
    would_fail = _taken(file, plan)
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
        "notes": [*prepared.notes, *_unserved(prepared), *would_fail],
        "warnings": list(plan.warnings),
    }
    if prepared.config.replay and prepared.config.replay.file:
        replay = prepare(file, "replay").plan
        found["replay"] = [_described(block, "") for block in replay.blocks]
        found["warnings"] += [warning for warning in replay.warnings if warning not in plan.warnings]
    lines = [dumps(found, indent=2)] if arguments.json else _lines(found, would_fail=bool(would_fail))
    print("\n".join(lines if arguments.json else map(printable, lines)))
    return 0


def _taken(file: Path, plan: Plan) -> list[str]:
    """Return a note for each address that another program uses.

    If the instance runs, or if its processes outlived the supervisor, there are no notes: these
    processes use the addresses, and ``up`` takes them over.
    """
    with suppress(ShmioError), Segment.open(plan.instance, config=file) as segment:
        if segment.supervised or any(slot.alive() for slot in segment.processes):
            return []
    return [f"note: up would fail at present: {problem}" for problem in taken(plan)]


def _unserved(prepared: Prepared) -> list[str]:
    """Return a note for each S7 source that reads from an address of this host without a listener.

    If the file has emulators, ``prepare`` warns instead.
    """
    notes = []
    for source in prepared.config.source if not prepared.config.emulator else ():
        device = peer(source)
        if source.connector == "s7" and ":" in device and (address := Address.parse(device)).loopback:
            with suppress(ConfigError):
                if not served(address):
                    notes.append(
                        f"note: source {source.name} reads {device}, where nothing listens at present, and this file "
                        "has no [[emulator]]: it will be bad until a device answers there"
                    )
    return notes


def _lines(found: dict[str, Any], *, would_fail: bool) -> list[str]:
    count, processes = len(found["warnings"]), len(found["processes"])
    warnings = f"{count} warning{'s' * (count != 1)}"
    end = f"usable, with {warnings}" if count else "no faults found"
    if would_fail:
        end = f"no faults{f', {warnings}' if count else ''} in the configuration; up would fail at present"
    return [
        f"{found['config']}: instance {found['instance']}, {processes} process{'es' * (processes != 1)}",
        *(f"  {_line(source)}" for source in found["sources"]),
        *(f"  {text}" for text in found["injections"]),
        *(f"  with --mode replay: {_line(source)}" for source in found["replay"]),
        f"  segment {found['segment']}: {found['segment_bytes'] / 1e6:.2f} MB of shared memory",
        *found["notes"],
        *found["warnings"],
        end,
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
