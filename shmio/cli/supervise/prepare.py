"""From the configuration file to a plan: layouts compiled, connectors and emulators asked whether they agree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from shmio.config import Address, Config, Emulator, Source, load
from shmio.config.read import unknown_option
from shmio.errors import ConfigError, PathError
from shmio.layout import compiler
from shmio.layout.glob import Glob
from shmio.layout.lexer import MAX_SOURCE_BYTES
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.supervisor.plan import Plan, make_plan

EMULATOR_KINDS = ("s7",)


@dataclass(frozen=True)
class Prepared:
    """A configuration that can be started, and what is odd about it, a line each."""

    config: Config
    plan: Plan
    layouts: dict[str, Layout]
    warnings: list[str]


def prepare(file: Path, mode: str = "live") -> Prepared:
    """Read and check everything that can be checked without starting anything; ConfigError, LayoutError."""
    config = load(file)
    files = _LayoutFiles(config)
    try:
        _check_listening(config)
        layouts = {}
        for index, source in enumerate(config.source):
            layouts[source.name] = _check_source(index, source, files)
        for index, emulator in enumerate(config.emulator):
            layouts[emulator.name] = _check_emulator(index, emulator, files)
        odd = _odd(config, layouts)
    except ConfigError as error:
        raise ConfigError(f"{file}: {error}") from None
    plan = make_plan(config, layouts, config_file=file, mode=mode)
    return Prepared(config, plan, layouts, [*files.warnings, *(f"{file}: warning: {text}" for text in odd)])


class _LayoutFiles:
    """Compiles each file once."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._compiled: dict[Path, tuple[Layout, ...]] = {}
        self.warnings: list[str] = []

    def get(self, key: str, text: str | None, number: object = None) -> Layout:
        """The file's data block; if it has several, the one of this number."""
        if text is None:
            raise ConfigError(f"{key}: this key is needed: the .db source of the data block")
        path = self._config.path(text)
        if path not in self._compiled:
            compiled = compiler.compile_sources([_read(key, path)])
            self._compiled[path] = compiled.layouts
            self.warnings += map(str, compiled.warnings)
        layouts = self._compiled[path]
        if len(layouts) > 1:
            layouts = tuple(layout for layout in layouts if layout.number is not None and layout.number == number)
        if len(layouts) != 1:
            names = ", ".join(layout.name for layout in self._compiled[path])
            raise ConfigError(f"{key}: {text} holds several data blocks ({names}); choose one by dbNumber")
        return layouts[0]


def _read(key: str, path: Path) -> compiler.Source:
    try:
        with path.open("rb") as file:
            return compiler.Source(str(path), file.read(MAX_SOURCE_BYTES + 4))
    except OSError as error:
        raise ConfigError(f"{key}: {path}: {error.strerror}") from None


def _check_source(index: int, source: Source, files: _LayoutFiles) -> Layout:
    # Connectors are imported here: status and its like do without them.
    from shmio.connectors import registry  # noqa: PLC0415

    key = f"source[{index}]"
    try:
        connector = registry.load(source.connector)
    except ConfigError as error:
        raise ConfigError(f"{key}.connector: {error}") from None
    known = [field.encode_name for field in msgspec.structs.fields(connector.Options)]
    for option in source.options:
        if option not in known:
            raise ConfigError(unknown_option(index, option, known))
    try:
        options = registry.convert_options(source.connector, source.options)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    layout = files.get(f"{key}.layout", source.layout, getattr(options, "dbNumber", None))
    try:
        connector(options, layout).close()
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    return layout


def _check_emulator(index: int, emulator: Emulator, files: _LayoutFiles) -> Layout:
    from shmio.emulators.programs import program  # noqa: PLC0415

    key = f"emulator[{index}]"
    if emulator.kind not in EMULATOR_KINDS:
        raise ConfigError(f"{key}.kind: {emulator.kind!r} is none; there are: {', '.join(EMULATOR_KINDS)}")
    layout = files.get(f"{key}.layout", emulator.layout)
    if layout.number is None:
        raise ConfigError(f"{key}.layout: the data block {layout.name!r} has no number in its name")
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
        if number is not None and layout.number is not None and str(number) != str(layout.number):
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
