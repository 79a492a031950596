"""``shmio-supervisor check``: validates a configuration and the files that it names. It starts nothing."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from shmio.cli.common import dumps
from shmio.cli.target import config_file
from shmio.config import Address, Alert, Source
from shmio.connectors.request_count import Requests
from shmio.errors import AlreadyRunningError, ConfigError, ShmioError
from shmio.layout.topic import shorten
from shmio.plan.host import open_doors
from shmio.plan.ports import served, taken
from shmio.plan.prepare import Prepared, peer, prepare
from shmio.plan.processes import Plan
from shmio.plan.request_count import can_write, source_requests, writable_registers
from shmio.segment import PREFIX, BlockSpec, Segment
from shmio.supervisor.start import refuse_running
from shmio.wording import counted, printable

MAX_PATTERNS: Final = 200
"""Maximum number of characters of a source's patterns that are printed in a line."""


def check(arguments: argparse.Namespace) -> int:
    """Print the processes, registers and memory that the instance would have."""
    file = config_file(arguments)
    prepared = prepare(file)
    plan = prepared.plan
    would_fail = _taken(file, plan)
    sources = list(zip(prepared.config.source, plan.blocks, strict=True))
    figures = [_Figures(source, block, arguments.round_trip_ms) for source, block in sources]
    slow = [text for index, one in enumerate(figures) for text in one.slow(f"source[{index}]")]
    found: dict[str, Any] = {
        "config": str(file),
        "instance": plan.instance,
        "processes": [job.name for job in plan.jobs],
        "sources": [
            _described(block, peer(source)) | one.found for (source, block), one in zip(sources, figures, strict=True)
        ],
        "injections": list(prepared.injections),
        "alerts": [_alert(alert) for alert in prepared.config.alert],
        "replay": [],
        "segment": f"{PREFIX}{plan.instance}",
        "segment_bytes": plan.segment_bytes,
        "notes": [*prepared.notes, *open_doors(prepared.config), *_unserved(prepared), *would_fail],
        "warnings": [*plan.warnings, *map(prepared.warning, slow)],
    }
    if prepared.config.replay and prepared.config.replay.file:
        replay = prepare(file, "replay").plan
        found["replay"] = [_described(block, "") for block in replay.blocks]
        found["warnings"] += [warning for warning in replay.warnings if warning not in plan.warnings]
    lines = [dumps(found, indent=2)] if arguments.json else _lines(found, would_fail=bool(would_fail))
    print("\n".join(lines if arguments.json else map(printable, lines)))
    return 0


def _taken(file: Path, plan: Plan) -> list[str]:
    """Return a note if an instance of another file has the same name, and one for each address in use.

    If the instance runs from this file, or its processes have survived their supervisor, there are no notes: these
    processes use the addresses, and ``up`` takes them over.
    """
    with suppress(ShmioError), Segment.open(plan.instance, config=file) as segment:
        if segment.supervised or any(slot.alive() for slot in segment.processes):
            return []
    problems = list(taken(plan))
    try:
        refuse_running(plan)
    except AlreadyRunningError as error:
        problems.insert(0, str(error))
    return [f"note: up would fail at present: {problem}" for problem in problems]


def _unserved(prepared: Prepared) -> list[str]:
    """Return a note for each S7 source that reads an address of this host where nothing listens.

    If the file has emulators, ``prepare`` warns about this instead.
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
    warnings = counted(count, "warning")
    end = f"usable, with {warnings}" if count else "no faults found"
    if would_fail:
        end = f"no faults{f', {warnings}' if count else ''} in the configuration; up would fail at present"
    return [
        f"{found['config']}: instance {found['instance']}, {processes} process{'es' * (processes != 1)}",
        *(f"  {line}" for source in found["sources"] for line in (_line(source), *_load_lines(source))),
        *(f"  {text}" for text in (*found["injections"], *found["alerts"])),
        *(f"  with --mode replay: {_line(source)}" for source in found["replay"]),
        f"  segment {found['segment']}: {found['segment_bytes'] / 1e6:.2f} MB of shared memory",
        *found["notes"],
        *found["warnings"],
        end,
    ]


def _alert(alert: Alert) -> str:
    """Return a line that says what an alert watches and does."""
    actions = [f"command {alert.command[0]}"] if alert.command else []
    actions += [f"MQTT topic {alert.mqtt_topic}"] if alert.mqtt_topic else []
    actions += [f"webhook at {urlsplit(alert.webhook).hostname}"] if alert.webhook else []
    name = f"{alert.name}: " if alert.name else ""
    return f"alert {name}{alert.watches}: {', '.join(actions) or 'no action, only shown and logged'}"


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
        f"source {source['source']}{at}: {source['block']}, {counted(source['registers'], 'register')}, "
        f"{source['bytes']} bytes; "
        f"ring of {source['ring_frames']} frames, {source['ring_s']:.1f} s, {source['ring_bytes'] / 1e6:.2f} MB"
    )


class _Figures:
    """Figures about a source: what it reads and may write, and whether its period can be met."""

    def __init__(self, source: Source, block: BlockSpec, round_trip_ms: float | None) -> None:
        self._requests = source_requests(source, block.layout)
        self._round_trip_ms = round_trip_ms
        self._period_ms = block.period_ns / 1e6
        self.found: dict[str, Any] = {
            "period_ms": self._period_ms,
            "reads": self._requests.reads if self._requests else None,
            "requests": [self._case(one) for one in self._requests.requests] if self._requests else [],
            "load_note": self._requests.note if self._requests else "",
            "writable": list(source.writable),
            "can_write": can_write(source, block.layout),
            "writable_registers": writable_registers(source, block.layout),
        }
        """The keys and values that ``--json`` prints for the source."""

    def _case(self, requests: Requests) -> dict[str, Any]:
        round_trips, round_trip_ms = requests.round_trips, self._round_trip_ms
        cycle_ms = None if round_trip_ms is None else round_trips * round_trip_ms
        return {
            "assumption": requests.assumption,
            "requests": requests.count,
            "in_flight": requests.in_flight,
            "round_trip_limit_ms": self._period_ms / round_trips if round_trips else None,
            "cycle_ms": cycle_ms,
            "met": None if cycle_ms is None else cycle_ms < self._period_ms,
        }

    def slow(self, key: str) -> Iterator[str]:
        """Yield a warning if the period cannot be met under any of the assumptions."""
        cases = self.found["requests"]
        if cases and not any(case["met"] in (True, None) for case in cases):
            best = min(cases, key=lambda case: case["cycle_ms"])
            how = ", with one request at a time" if best["in_flight"] == 1 else ""
            yield (
                f"{key}.period_ms: {self._period_ms:g} ms cannot be met with a round trip of {self._round_trip_ms:g} "
                f"ms{how}: a cycle takes at least {best['cycle_ms']:g} ms; raise period_ms above it, or read less"
            )


def _load_lines(source: dict[str, Any]) -> Iterator[str]:
    """Yield lines that say what a source reads and what commands may write."""
    if source["reads"] is not None:
        cases, note = source["requests"], source["load_note"]
        if not cases:
            yield f"  reads {source['reads']}, without requests in each cycle{f': {note}' if note else ''}"
        elif len(cases) == 1 and not cases[0]["assumption"]:
            yield f"  reads {source['reads']} in {_case_text(cases[0], source['period_ms'])}"
        else:
            yield f"  reads {source['reads']}:"
            for case in cases:
                yield f"    with a {case['assumption']} in {_case_text(case, source['period_ms'])}"
        if cases and note:
            yield f"    {note}"
    if count := source["writable_registers"]:
        patterns = shorten(", ".join(source["writable"]), MAX_PATTERNS)
        yield f"  writable: {counted(count, 'register')}: {patterns}"
    elif source["writable"]:
        why = "the patterns match nothing" if source["can_write"] else "the connector cannot write"
        yield f"  writable: no registers, because {why}"


def _case_text(case: dict[str, Any], period_ms: float) -> str:
    count, together = case["requests"], case["in_flight"]
    text = f"{counted(count, 'request')} a cycle"
    if count > 1:
        text += (
            ", all at once"
            if together >= count
            else ", one after the other"
            if together == 1
            else (f", {together} at once")
        )
    if case["met"] is None:
        limit_ms = case["round_trip_limit_ms"]
        return text if limit_ms is None else f"{text}; {period_ms:g} ms need a round trip below {limit_ms:.3g} ms"
    can = "can be met" if case["met"] else "cannot be met"
    return f"{text}: at least {case['cycle_ms']:g} ms; the period of {period_ms:g} ms {can}"
