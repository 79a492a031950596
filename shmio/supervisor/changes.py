"""Compares an instance with a plan: finds what must change and why, and what cannot change during a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from shmio.config import Declaration
from shmio.config.masking import is_secret, mask_value
from shmio.layout.model import Layout
from shmio.layout.topic import shorten
from shmio.plan.processes import Plan
from shmio.segment import Block, BlockSpec, Quality, Segment
from shmio.supervisor.fleet import Fleet, digest
from shmio.wording import MAX_PATHS


@dataclass(frozen=True, slots=True)
class Changes:
    """The differences between an instance and a plan.

    ``kept``, ``started``, ``stopped``, ``replaced`` and ``changed`` have names of processes. Those in
    ``replaced`` are restarted. Those in ``changed``, which are sources and emulators, keep running,
    with their connections. ``add`` has the blocks to create, and ``retire`` the sources whose present
    blocks are retired.
    """

    kept: tuple[str, ...]
    started: tuple[str, ...]
    stopped: tuple[str, ...]
    replaced: tuple[str, ...]
    changed: tuple[str, ...]
    add: tuple[BlockSpec, ...]
    retire: tuple[str, ...]


def reconcile(plan: Plan, epoch: int, fleet: Fleet, blocks: Iterable[Block]) -> Changes:
    """Compare a plan with the present processes (``fleet``) and blocks of the segment with this epoch.

    If a source's block is replaced, the source's process is restarted, because it writes to one block
    only. If the source connects to its device as before, the process instead keeps its connection,
    and continues with the new block.
    """
    present = {block.source: block for block in blocks}
    add = tuple(spec for spec in plan.blocks if spec.source not in present or not _same(spec, present[spec.source]))
    planned = {spec.source for spec in plan.blocks}
    retire = (*(spec.source for spec in add if spec.source in present), *(n for n in present if n not in planned))
    new_blocks = {spec.source for spec in add}
    kept, started, replaced, changed = [], [], [], []
    processes = {managed.name: managed for managed in fleet}
    stopped = [name for name in processes if name not in {job.name for job in plan.jobs}]
    for job in plan.jobs:
        there = processes.get(job.name)
        if there is None:
            started.append(job.name)
        elif there.slot.kind != job.kind:  # the name now belongs to a process of another kind
            stopped.append(job.name)
            started.append(job.name)
        elif (
            there.well
            and there.slot.digest == digest(job.identify(plan.instance, epoch))
            and not (job.kind == "source" and job.name in new_blocks)
        ):
            kept.append(job.name)
        elif there.can_follow(job):
            changed.append(job.name)
        else:
            replaced.append(job.name)
    return Changes(tuple(kept), tuple(started), tuple(stopped), tuple(replaced), tuple(changed), add, retire)


def _same(spec: BlockSpec, block: Block) -> bool:
    """Return whether a block matches its specification."""
    return (
        block.layout.hash == spec.layout.hash
        and block.ring.slot_count == spec.slots
        and (block.period_ns, block.stale_ns) == (spec.period_ns, spec.stale_ns)
        and block.attributes == spec.attributes
    )


def refusal(plan: Plan, running: Plan) -> str | None:
    """Return why a running instance cannot change to the plan; None if it can."""
    fixed = {
        "instance.name": (running.instance, plan.instance),
        "instance.group": (running.group, plan.group),
        "instance.clock": (_clock(running), _clock(plan)),
        "instance.log_dir": (running.log_dir, plan.log_dir),
        "instance.snapshot_dir": (running.snapshot_dir, plan.snapshot_dir),
        "instance.log_format": (running.log_format, plan.log_format),
        **{f"instance.{key}": (_audit(running, key), _audit(plan, key)) for key in AUDIT_KEYS},
    }
    for key, (old, new) in fixed.items():
        if old != new:
            return (
                f"{key}: this key cannot change from {_shown(old)} to {_shown(new)} while the instance runs, so "
                "nothing was changed; to apply it, run shmio-supervisor down and up"
            )
    return None


def _clock(plan: Plan) -> str:
    return "stepped" if plan.stepped else "wall"


AUDIT_KEYS: Final = ("audit", "audit_mb", "audit_files")


def _audit(plan: Plan, key: str) -> object:
    """Return the value of a key of ``[instance]`` about the audit log."""
    if plan.audit is None:
        return False if key == "audit" else None
    return {"audit": True, "audit_mb": plan.audit.max_bytes / 1e6, "audit_files": plan.audit.files}[key]


def _shown(value: object) -> str:
    return "none" if value is None else repr(str(value))


MAX_REASONS: Final = 8
"""Maximum number of reasons that are given for the restart of one process."""
MAX_VALUE: Final = 60
"""Maximum number of characters of a changed value that is shown."""


def preview(plan: Plan, running: Plan, epoch: int, fleet: Fleet, segment: Segment) -> dict[str, list[str]]:
    """Return what applying a plan to a running instance would change, as lines by kind of change.

    Raises:
        SegmentError: There is no room for new processes or blocks.

    """
    changes = reconcile(plan, epoch, fleet, segment.blocks.values())
    segment.processes.require(len(changes.started) - len(changes.stopped))
    segment.require_blocks(len(changes.add))
    jobs = {job.name: job for job in plan.jobs}
    return {
        "stop": list(changes.stopped),
        "start": list(changes.started),
        "restart": [f"{name}: {'; '.join(_reasons(name, plan, running, fleet))}" for name in changes.replaced],
        "change": [
            f"{name}: {'; '.join([*_reasons(name, plan, running, fleet), *_unconnected(segment.blocks.get(name))])}"
            for name in changes.changed
        ],
        "injections": list(_changed_injections(plan, running)),
        "reread": [name for name in changes.kept if fleet.named(name).rereads(jobs[name])],
        "keep": list(changes.kept),
    }


def _unconnected(block: Block | None) -> Iterator[str]:
    """Yield why a source has no connection that it could keep. Yield nothing for an emulator: it has no block."""
    frame = block.latest() if block is not None else None
    if frame is not None and frame.quality is Quality.BAD:
        yield f"but it is not connected now: {frame.reason}"


def _reasons(name: str, plan: Plan, running: Plan, fleet: Fleet) -> list[str]:
    """Return why a process has to be restarted or changed. Secrets are masked."""
    managed = fleet.named(name)
    old, new = (next((job for job in one.jobs if job.name == name), None) for one in (running, plan))
    blocks = [next((block for block in one.blocks if block.source == name), None) for one in (running, plan)]
    found = [] if managed.well else [f"it is not running: {managed.life.note or managed.life.state.value}"]
    if old is not None and new is not None:
        found += _differences(old.config, new.config)
    if blocks[0] is not None and blocks[1] is not None:
        found += _block_differences(blocks[0], blocks[1])
    found = found or ["its configuration has changed"]
    return found if len(found) <= MAX_REASONS else [*found[:MAX_REASONS], f"{len(found) - MAX_REASONS} more"]


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], table: str = "") -> Iterator[str]:
    """Yield the keys whose values differ, with the values if they are short."""
    for key in {**old, **new}:
        before, after = old.get(key), new.get(key)
        if before == after:
            continue
        if isinstance(before, dict) and isinstance(after, dict) and not is_secret(key):
            yield from _differences(before, after, f"{table}{key}.")
            continue
        texts = [_text(mask_value(key, value)) for value in (before, after)]
        shown = texts[0] != texts[1] and all(len(text) <= MAX_VALUE for text in texts)
        yield f"{table}{key}: {texts[1]} instead of {texts[0]}" if shown else f"{table}{key} has changed"


def _text(value: Any) -> str:
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return "none" if value is None else msgspec.json.encode(value).decode()


def _block_differences(old: BlockSpec, new: BlockSpec) -> Iterator[str]:
    """Yield the differences of a source's block that do not show in the source's keys."""
    if old.layout.hash != new.layout.hash:
        yield f"registers: {register_changes(old.layout, new.layout)}"
    if old.slots != new.slots:
        yield f"ring: {new.slots} frames instead of {old.slots}"


def register_changes(old: Layout, new: Layout) -> str:
    """Return which registers a new layout adds, removes and moves, and which it changes otherwise."""
    before, after = ({one.path: one for one in layout.registers} for layout in (old, new))
    kinds: dict[str, list[str]] = {
        "added": [path for path in after if path not in before],
        "gone": [path for path in before if path not in after],
    }
    for path in (path for path in before if path in after and before[path] != after[path]):
        there = after[path]
        place = msgspec.structs.replace(before[path], offset=there.offset, bit=there.bit, address=there.address)
        kinds.setdefault("moved" if place == there else "changed", []).append(path)
    parts = [f"{len(paths)} {what} ({_few(paths)})" for what, paths in kinds.items() if paths]
    return ", ".join(parts) or "none changed"


def _few(paths: Sequence[str]) -> str:
    return f"{', '.join(map(shorten, paths[:MAX_PATHS]))}{', …' if len(paths) > MAX_PATHS else ''}"


def _changed_injections(plan: Plan, running: Plan) -> Iterator[str]:
    """Yield a line for each declared injection that is created, changed or lifted."""
    before = {block.source: injections_by_name(block.declared) for block in running.blocks}
    for block in plan.blocks:
        yield from injection_changes(block.source, before.get(block.source, {}), injections_by_name(block.declared))


def injections_by_name(document: bytes) -> dict[str, Declaration]:
    """Return the declared injections in a block's document, by name."""
    return {one.name: one for one in msgspec.json.decode(document or b"[]", type=tuple[Declaration, ...])}


def injection_changes(
    source: str, before: Mapping[str, Declaration], after: Mapping[str, Declaration]
) -> Iterator[str]:
    """Yield a line for each injection of a source that is created, changed or lifted by a change of plan.

    ``before`` and ``after`` have the declared injections by name.
    """
    for name in {**before, **after}:
        if before.get(name) != after.get(name):
            what = "created" if name not in before else "changed" if name in after else "lifted"
            yield f"injection {name}: {what} at {source}"
