"""The sources of a configuration: their connectors asked whether all goes together, their layouts found.

Connectors are imported here, and only when they are asked: status and its like do without them.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec

from shmio.cli.supervise.layouts import LayoutFiles
from shmio.cli.supervise.recordings import Recordings
from shmio.config import Config, Source
from shmio.config.read import unknown_option
from shmio.errors import ConfigError, RecordingError
from shmio.layout.model import Layout


class Sources(NamedTuple):
    """What was found out about the sources, by their names."""

    layouts: dict[str, Layout]
    computed: list[str]
    """Those that live on the instance's clock."""
    replayed: list[str]
    """Those that play a recording."""
    remote: dict[str, tuple[list[str], list[str]]]
    """Patterns of what a program elsewhere computes, of sources that have such: outputs, in-outs."""


def check_sources(config: Config, files: LayoutFiles, recordings: Recordings) -> Sources:
    """Ask the connectors of all sources whether they can be as configured.

    Their ``options`` are complete and of their types from here on. ConfigError, LayoutError.
    """
    from shmio.connectors import registry  # noqa: PLC0415
    from shmio.connectors.computed import Computed  # noqa: PLC0415
    from shmio.connectors.replayed import Replayed  # noqa: PLC0415

    layouts: dict[str, Layout] = {}
    inputs: dict[int, tuple[str, ...]] = {}
    computed = []
    replayed = []
    remote: dict[str, tuple[list[str], list[str]]] = {}
    for index, source in enumerate(config.source):
        key = f"source[{index}]"
        options = _options(index, source)
        found = registry.load(source.connector)
        if issubclass(found, Computed | Replayed):
            computed.append(source.name)
        if issubclass(found, Replayed):
            replayed.append(source.name)
            layouts[source.name] = _recorded(key, source, config, recordings)
            continue
        if source.connector == "simulation":
            layouts[source.name], inputs[index] = _model(key, source, config, files)
            continue
        layout = layouts[source.name] = files.get(key, source, source.options.get("dbNumber"))
        try:
            made = found(options, layout)
        except ConfigError as error:
            raise ConfigError(f"{key}.{error}") from None
        if isinstance(made, Computed):
            inputs[index] = made.inputs
        else:
            made.close()
        if source.connector == "remote":
            remote[source.name] = source.options["outputs"], source.options["inouts"]
    for index, paths in inputs.items():
        from shmio.cli.supervise.models import check_connections  # noqa: PLC0415

        source = config.source[index]
        check_connections(f"source[{index}]", source.name, source.options.get("connections", {}), paths, layouts)
    return Sources(layouts, computed, replayed, remote)


def _options(index: int, source: Source) -> msgspec.Struct:
    """The connector's own keys, checked; ConfigError."""
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
    return options


def _recorded(key: str, source: Source, config: Config, recordings: Recordings) -> Layout:
    """The layout of a replay: that of the recording, which has its period and its age, too."""
    from shmio.connectors.replay.source import Replay, chosen, files  # noqa: PLC0415

    for name in ("layout", "block", "type_bytes", "properties"):
        if getattr(source, name):
            raise ConfigError(f"{key}.{name}: a replay has none: its registers are those of the recording")
    options = msgspec.convert(source.options, Replay.Options)
    source.options["file"] = [str(config.path(file)) for file in files(options)]
    try:
        recording = recordings.get(source.options["file"])
    except RecordingError as error:
        raise ConfigError(f"{key}.file: {error}") from None
    try:
        block = chosen(recording, options, source.name)[1].block
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    source.period_ms, source.stale_ms = block.period_ns / 1e6, block.stale_ns / 1e6
    return block.layout


def _model(key: str, source: Source, config: Config, files: LayoutFiles) -> tuple[Layout, tuple[str, ...]]:
    """The layout and the inputs of a simulation: those of its files, if it has any, else what its model declares."""
    from shmio.cli.supervise.models import describe  # noqa: PLC0415
    from shmio.connectors.simulation import Simulation  # noqa: PLC0415

    source.options["folder"] = str(config.path(source.options["folder"]))
    layout = None if source.layout is None else files.get(key, source, None)
    return describe(key, msgspec.convert(source.options, Simulation.Options), layout)
