"""Checks the configured injections against registers, types, conditions and the source's limits."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import msgspec

from shmio.config import Config, Declaration, Source
from shmio.config.faults import Faults
from shmio.connectors import registry
from shmio.connectors.base import Connector
from shmio.connectors.injection_layers import MAX_INJECTIONS
from shmio.connectors.output import GROWTH, unwritable
from shmio.errors import ConfigError
from shmio.injection import Program, compile_program
from shmio.layout.model import Layout
from shmio.layout.values.write import cover
from shmio.model.injection import Running
from shmio.model.values import NO_WRITER
from shmio.segment import Provenance
from shmio.segment.injection_list import InjectionEntry, declared_document, encode, ranges_of


def check_injections(
    config: Config, layouts: Mapping[str, Layout], faults: Faults, is_unsure: Callable[[str], bool]
) -> tuple[dict[str, bytes], tuple[str, ...]]:
    """Return the encoded injections for each source's process, by source name, and a line about each injection.

    Faults are added to ``faults``. ``is_unsure`` returns whether a text may name a source whose registers are unknown.
    """
    periods_ns = {source.name: source.period_ns for source in config.source}
    found: dict[str, list[Program]] = {}
    described = []
    for index, declaration in enumerate(config.injection):
        if is_unsure(f"{declaration.target} {declaration.when}"):
            continue
        try:
            if not config.source:
                raise ConfigError("target: the configuration has no [[source]]")
            program = compile_program(declaration, layouts, periods_ns)
            source = next(source for source in config.source if source.name == program.source)
            if source.connector == "fabric":
                cell = source.options.get("cell")
                raise ConfigError(
                    f"target: source {source.name!r} is a mirror; declare the injection in the supervisor.toml of its "
                    f"owner, cell {cell}, or from here by shmio inject --file"
                )
            if program.direction == "in":
                _check_in(program, source, layouts[source.name])
        except ConfigError as error:
            faults.add(f"injection[{index}].{error}")
            continue
        found.setdefault(program.source, []).append(program)
        over = f"{declaration.operation} over source {program.source} /{program.direction}"
        described.append(f"injection {declaration.name}: {over}")
    documents: dict[str, bytes] = {}
    for name, programs in found.items():
        with faults.catching():
            documents[name] = _document(name, programs)
    return documents, tuple(described)


def _check_in(program: Program, source: Source, layout: Layout) -> None:
    connector = registry.load(source.connector)
    device = issubclass(connector, Connector) and connector.provenance is Provenance.LIVE
    if issubclass(connector, Connector) and not connector.can_write:
        raise ConfigError(f"target: {source.name}/…/in: the source's connector cannot write")
    if device and not source.armed:
        raise ConfigError(f"target: an injection toward a device needs `armed = true` in source {source.name!r}")
    if reason := unwritable(source.name, layout, program.cover, cover(layout, source.writable)):
        raise ConfigError(f"target: {reason}")


def _document(source: str, programs: list[Program]) -> bytes:
    declarations: Iterable[Declaration] = [program.declaration for program in programs]
    try:
        if len(programs) > MAX_INJECTIONS:
            raise ValueError(f"at most {MAX_INJECTIONS} are allowed")
        encode([msgspec.json.encode(_to_entry(program)) for program in programs], GROWTH * len(programs))
        return declared_document(declarations)
    except ValueError as error:
        raise ConfigError(f"injection: source {source!r} has {len(programs)} injections: {error}") from None


def _to_entry(program: Program) -> InjectionEntry:
    """Return a declared injection in the form in which its source's process publishes it."""
    declaration = program.declaration
    return InjectionEntry(
        2**64 - 1, program.direction, declaration.priority, True, declaration.name, NO_WRITER, 0,
        ranges_of(program.cover.tobytes()), Running(declaration, "waiting", 2**63 - 1),
    )  # fmt: skip
