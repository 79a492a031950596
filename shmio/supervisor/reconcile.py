"""Compares an instance with its plan, and returns what must change. No I/O.

A reload and a take-over use the same rule: what matches the plan is left alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from shmio.plan.processes import Plan
from shmio.segment import Block, BlockSpec


class CurrentProcess(NamedTuple):
    """A process of the instance. ``well`` says whether it works or is being restarted."""

    kind: str
    digest: bytes
    well: bool


@dataclass(frozen=True, slots=True)
class Changes:
    """What to do, by name: stop, then change the blocks, then start.

    ``replaced`` processes stop and start.
    """

    kept: tuple[str, ...]
    started: tuple[str, ...]
    stopped: tuple[str, ...]
    replaced: tuple[str, ...]
    add: tuple[BlockSpec, ...]
    retire: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.started or self.stopped or self.replaced or self.add or self.retire)


def digest(description: bytes) -> bytes:
    """Return the SHA-256 of a process description, for comparing."""
    return hashlib.sha256(description).digest()


def reconcile(plan: Plan, epoch: int, processes: Mapping[str, CurrentProcess], blocks: Iterable[Block]) -> Changes:
    """Compare a plan with the present processes and blocks.

    A source is replaced together with its block, because a source process writes to one block only.
    """
    present = {block.source: block for block in blocks}
    add = tuple(spec for spec in plan.blocks if spec.source not in present or not same(spec, present[spec.source]))
    planned = {spec.source for spec in plan.blocks}
    retire = (*(spec.source for spec in add if spec.source in present), *(n for n in present if n not in planned))
    changed = {spec.source for spec in add}
    kept, started, replaced = [], [], []
    stopped = [name for name in processes if name not in {job.name for job in plan.jobs}]
    for job in plan.jobs:
        there = processes.get(job.name)
        if there is None:
            started.append(job.name)
        elif there.kind != job.kind:  # another process of the same name
            stopped.append(job.name)
            started.append(job.name)
        elif (
            there.well
            and there.digest == digest(job.identify(plan.instance, epoch))
            and not (job.kind == "source" and job.name in changed)
        ):
            kept.append(job.name)
        else:
            replaced.append(job.name)
    return Changes(tuple(kept), tuple(started), tuple(stopped), tuple(replaced), add, retire)


def same(spec: BlockSpec, block: Block) -> bool:
    """Return whether a block matches its specification."""
    return (
        block.layout.hash == spec.layout.hash
        and block.ring.slot_count == spec.slots
        and (block.period_ns, block.stale_ns) == (spec.period_ns, spec.stale_ns)
        and block.attributes == spec.attributes
    )


def refusal(plan: Plan, running: Plan) -> str | None:
    """Return why a running instance cannot adopt the plan; None if it can."""
    fixed = {
        "instance.name": (running.instance, plan.instance),
        "instance.group": (running.group, plan.group),
        "instance.clock": (_clock(running), _clock(plan)),
        "instance.log_dir": (running.log_dir, plan.log_dir),
    }
    for key, (old, new) in fixed.items():
        if old != new:
            return (
                f"{key}: {_shown(new)} instead of {_shown(old)} cannot be taken while the instance runs; "
                "nothing has changed: shmio-supervisor down and up take it"
            )
    return None


def _clock(plan: Plan) -> str:
    return "stepped" if plan.stepped else "wall"


def _shown(value: object) -> str:
    return "none" if value is None else repr(str(value))
