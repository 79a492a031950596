"""``shmio-supervisor check``: validate a configuration and what it names; start nothing."""

from __future__ import annotations

import argparse

from shmio.cli.supervise.prepare import prepare
from shmio.cli.supervise.target import config_file
from shmio.logs import printable
from shmio.segment import PREFIX, BlockSpec


def execute(arguments: argparse.Namespace) -> int:
    """Print what the instance would take; errors go the usual way."""
    file = config_file(arguments)
    prepared = prepare(file)
    plan = prepared.plan
    print(f"{file}: instance {plan.instance}, {len(plan.jobs)} processes")
    for block in plan.blocks:
        print(f"  {_describe(block)}")
    print(f"  segment {PREFIX}{plan.instance}: {plan.segment_bytes / 1e6:.2f} MB of shared memory")
    for warning in prepared.warnings:
        print(printable(warning))
    count = len(prepared.warnings)
    print(f"usable, with {count} warning{'s' * (count != 1)}" if count else "no faults found")
    return 0


def _describe(block: BlockSpec) -> str:
    layout = block.layout
    held_s = block.slots * block.period_ns / 1e9
    return (
        f"source {block.source}: {layout.name}, {len(layout.registers)} registers, {layout.size} bytes; "
        f"ring of {block.slots} frames, {held_s:.1f} s, {block.size / 1e6:.2f} MB"
    )
