"""``shmio-supervisor check``: validate a configuration and what it names; start nothing."""

from __future__ import annotations

import argparse

from shmio.cli.supervise.prepare import peer, prepare
from shmio.cli.target import config_file
from shmio.logs import printable
from shmio.segment import PREFIX, BlockSpec


def execute(arguments: argparse.Namespace) -> int:
    """Print what the instance would take; errors go the usual way."""
    file = config_file(arguments)
    prepared = prepare(file)
    plan = prepared.plan
    print(f"{file}: instance {plan.instance}, {len(plan.jobs)} processes")
    for source, block in zip(prepared.config.source, plan.blocks, strict=True):
        print(printable(f"  {_describe(block, peer(source))}"))
    for text in prepared.injections:
        print(printable(f"  {text}"))
    warnings = [*plan.warnings]
    if prepared.config.replay and prepared.config.replay.file:
        replay = prepare(file, "replay").plan
        for block in replay.blocks:
            print(printable(f"  with --mode replay: {_describe(block, '')}"))
        warnings += [warning for warning in replay.warnings if warning not in warnings]
    print(f"  segment {PREFIX}{plan.instance}: {plan.segment_bytes / 1e6:.2f} MB of shared memory")
    for warning in warnings:
        print(printable(warning))
    count = len(warnings)
    print(f"usable, with {count} warning{'s' * (count != 1)}" if count else "no faults found")
    return 0


def _describe(block: BlockSpec, peer: str) -> str:
    layout = block.layout
    held_s = block.slots * block.period_ns / 1e9
    at = f" at {peer}" if peer else ""
    return (
        f"source {block.source}{at}: {layout.name}, {len(layout.registers)} registers, {layout.size} bytes; "
        f"ring of {block.slots} frames, {held_s:.1f} s, {block.size / 1e6:.2f} MB"
    )
