"""From the configuration file to a plan: layouts compiled, connectors and emulators asked whether they agree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from shmio.cli.supervise.host import check_host
from shmio.cli.supervise.layouts import LayoutFiles
from shmio.config import Address, Config, Emulator, Source, load
from shmio.config.read import unknown_option
from shmio.config.wording import named
from shmio.errors import ConfigError, PathError
from shmio.layout.glob import Glob
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.supervisor.plan import Plan, make_plan

EMULATOR_KINDS = ("s7",)


@dataclass(frozen=True)
class Prepared:
    """A configuration that can be started."""

    config: Config
    plan: Plan
    layouts: dict[str, Layout]


def prepare(file: Path, mode: str = "live") -> Prepared:
    """Read and check everything that can be checked without starting anything; ConfigError, LayoutError."""
    config = load(file)
    if mode == "log" and config.recorder is None:
        raise ConfigError(
            f"{file}: --mode log reads the sources and records them, and there is no [recorder] section: "
            'add one, such as [recorder] with directory = "dumps", or leave out --mode log'
        )
    files = LayoutFiles(config)
    try:
        check_host(config)
        _check_listening(config)
        layouts = {}
        for index, source in enumerate(config.source):
            layouts[source.name] = _check_source(index, source, files)
        for index, emulator in enumerate(config.emulator):
            layouts[emulator.name] = _check_emulator(index, emulator, files)
        odd = _odd(config, layouts)
    except ConfigError as error:
        raise ConfigError(f"{file}: {named(str(error), msgspec.to_builtins(config))}") from None
    warnings = [*files.warnings, *(f"{file}: warning: {text}" for text in odd)]
    return Prepared(config, make_plan(config, layouts, config_file=file, mode=mode, warnings=warnings), layouts)


def peer(source: Source) -> str:
    """The device of a checked source, as host:port where it has such; empty if not."""
    host, port = source.options.get("host"), source.options.get("port")
    return str(Address(host, port)) if host and port else str(host or "")


def _check_source(index: int, source: Source, files: LayoutFiles) -> Layout:
    """The source's layout; its ``options`` are complete and of their types from here on."""
    # Connectors are imported here: status and its like do without them.
    from shmio.connectors import registry  # noqa: PLC0415

    key = f"source[{index}]"
    try:
        connector = registry.load(source.connector)
    except ConfigError as error:
        raise ConfigError(f"{key}.connector: {error}") from None
    known = [field.encode_name for field in msgspec.structs.fields(connector.Options)]
    for option in (*source.options, *source.texts):
        if option not in known:
            raise ConfigError(unknown_option(index, option, known))
    try:
        options = registry.convert_options(source.connector, source.options, source.texts)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    source.options, source.texts = msgspec.to_builtins(options), {}
    layout = files.get(key, source, source.options.get("dbNumber"))
    try:
        connector(options, layout).close()
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    return layout


def _check_emulator(index: int, emulator: Emulator, files: LayoutFiles) -> Layout:
    from shmio.emulators.programs import program  # noqa: PLC0415

    key = f"emulator[{index}]"
    if emulator.kind not in EMULATOR_KINDS:
        raise ConfigError(f"{key}.kind: {emulator.kind!r} is none; there are: {', '.join(EMULATOR_KINDS)}")
    layout = files.get(key, emulator, emulator.dbNumber)
    if layout.number is None and emulator.dbNumber is None:
        raise ConfigError(
            f"{key}.dbNumber: this key is needed, for the data block {layout.name!r} has no number in its name"
        )
    try:
        program(emulator.program, layout)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    return layout


def _check_listening(config: Config) -> None:
    """No address twice; port 0 is any free one."""
    listening = [(f"emulator[{i}].listen", emulator.listen) for i, emulator in enumerate(config.emulator)]
    if config.grpc:
        listening += [(f"grpc.listen[{i}]", text) for i, text in enumerate(config.grpc.listen)]
    seen: dict[Address, str] = {}
    for key, text in listening:
        address = Address.parse(text)
        if address.port and address in seen:
            raise ConfigError(f"{key}: {text} is the address of {seen[address]} already")
        seen[address] = key


def _odd(config: Config, layouts: dict[str, Layout]) -> list[str]:
    """What is allowed and yet hardly meant."""
    odd = []
    for index, source in enumerate(config.source):
        key, layout = f"source[{index}]", layouts[source.name]
        for pattern in source.writable:
            try:
                if not _covers(pattern, layout):
                    odd.append(f"{key}.writable: {pattern!r} names nothing in {layout.name}")
            except PathError as error:
                raise ConfigError(f"{key}.writable: {error}") from None
        number = source.options.get("dbNumber")
        if number is not None and layout.number is not None and number != layout.number:
            odd.append(f"{key}.dbNumber: {number}, but the layout is that of DB{layout.number}")
    if not config.source:
        odd.append("there is no [[source]]: the instance will hold no registers")
    return odd


def _covers(pattern: str, layout: Layout) -> bool:
    """Whether a pattern names a register, what is above one, or an element."""
    glob = Glob(pattern)
    for register in layout.registers:
        if glob.matches(register.path):
            return True
        if register.dims and glob.matches(layout.element(register, tuple(low for low, _ in register.dims)).path):
            return True
    if "*" in pattern:
        return False
    try:
        find(layout, pattern)
    except PathError:
        return False
    return True
