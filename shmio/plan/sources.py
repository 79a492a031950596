"""Checks a configuration's sources with their connectors and models, and finds their layouts."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from urllib.parse import urlsplit

import msgspec

from shmio.config import Config, Source
from shmio.config.address import check_host
from shmio.config.faults import Faults
from shmio.config.read import unknown_option
from shmio.connectors import registry
from shmio.connectors.base import Computed, Connector, Mirrored, Replayed
from shmio.errors import ConfigError, PathError, RecordingError, RemoteError, ShmioError, ValueRangeError
from shmio.fabric.connection import Access
from shmio.fabric.place import Place, is_place, parse_place
from shmio.layout.document import load_layout
from shmio.layout.encodings import ISO_8859_1
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.topic import find, look_up, parse_topic
from shmio.layout.values.codec import codec
from shmio.local.replays import date_ns
from shmio.plan.layouts import LayoutFiles, encoding_of
from shmio.plan.replay import Recordings
from shmio.wording import near, unknown

if TYPE_CHECKING:
    from shmio.connectors.models.simulation import Simulation

NEEDED: Final = "this key is needed"
PATIENCE_S: Final = 60.0
"""Time-out in s for the import of a model."""


class Sources(NamedTuple):
    """What :func:`check_sources` finds out about the sources, by source name."""

    layouts: dict[str, Layout]
    computed: list[str]
    """Names of the sources that follow the instance's clock."""
    replayed: list[str]
    """Names of the sources that play a recording."""
    remote: dict[str, tuple[list[str], list[str]]]
    """For each source that a remote program computes: patterns of its outputs, and of its in-out registers."""
    register_options: dict[str, tuple[str, frozenset[str]]]
    """For each source that can change without a new connection: its connector's class and ``register_options``."""


def check_sources(
    config: Config, files: LayoutFiles, recordings: Recordings, faults: Faults, *, all_sources: bool
) -> Sources:
    """Check each source with its connector, and add the problems to ``faults``.

    The function also completes the ``options`` of each source: they then have all keys, with values
    of the right types. ``all_sources`` says whether the configuration has all sources of the file; otherwise, a
    connection may be to one that was left out.
    """
    before = faults.count
    found = Sources({}, [], [], {}, {})
    inputs: dict[int, tuple[str, ...]] = {}
    for index, source in enumerate(config.source):
        with faults.catching():
            _check_source(index, source, found, inputs, config, files, recordings, faults)
    if all_sources and faults.count == before:
        for index, paths in inputs.items():
            source, key = config.source[index], f"source[{index}]"
            with faults.catching():
                _check_connections(key, source.name, source.options.get("connections", {}), paths, found.layouts)
    return found


def _check_source(
    index: int,
    source: Source,
    found: Sources,
    inputs: dict[int, tuple[str, ...]],
    config: Config,
    files: LayoutFiles,
    recordings: Recordings,
    faults: Faults,
) -> None:
    key = f"source[{index}]"
    options = _options(key, source, faults)
    for name, host in named_hosts(source.options):
        try:
            check_host(host)
        except ConfigError as error:
            faults.add(f"{key}.{name}: {error}")
    try:
        connector = registry.load(source.connector)
    except ConfigError:  # reported with the options
        return
    if issubclass(connector, Computed | Replayed):
        found.computed.append(source.name)
    if issubclass(connector, Replayed):
        found.replayed.append(source.name)
        if options is not None:
            found.layouts[source.name] = _recorded(key, source, config, recordings)
        return
    if issubclass(connector, Mirrored):
        if options is not None:
            found.layouts[source.name] = _mirrored(key, source, config, files)
        return
    if source.connector == "simulation":
        if options is not None:
            found.layouts[source.name], inputs[index] = _model(key, source, config, files)
        return
    optimized = issubclass(connector, Connector) and connector.reads_optimized
    layout = files.get(key, source, source.options.get("dbNumber"), optimized=optimized)
    if issubclass(connector, Connector):
        connector = connector.for_layout(layout)
        if connector.register_quality:
            layout = layout.with_statuses()
        if connector.register_options is not None:
            where = f"{connector.__module__}.{connector.__qualname__}"
            found.register_options[source.name] = where, connector.register_options
        if options is not None and (paths := [name for name in connector.path_options if source.options[name]]):
            source.options |= {name: str(config.path(source.options[name])) for name in paths}
            options = msgspec.convert(source.options, connector.Options)
    found.layouts[source.name] = layout
    if issubclass(connector, Connector):
        layout = layout.base  # the device does not know the registers of tag tables over the block
    if options is None:  # their faults have been added; let the connector check the rest
        options = _filled(connector.Options, source)
        if options is None:
            return
    try:
        made = connector(options, layout)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    if isinstance(made, Computed):
        inputs[index] = made.inputs
    elif not isinstance(made, Replayed):
        made.close()
    if source.connector == "remote" and "outputs" in source.options:
        found.remote[source.name] = source.options["outputs"], source.options["inouts"]


def named_hosts(options: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (key, host) for each host that a source's options name."""
    if isinstance(host := options.get("host"), str):
        yield "host", host
    if isinstance(url := options.get("url"), str):
        with suppress(ValueError):  # reported with the options
            yield "url", urlsplit(url).hostname or ""


def note_options(index: int, connector: str, options: dict[str, Any], texts: dict[str, str], faults: Faults) -> None:
    """Add faults to ``faults`` if a source's connector is unknown, or the keys for the connector are wrong.

    Args:
        index: Index of the source in the file.
        connector: Name of the connector.
        options: The connector's keys in the section.
        texts: The connector's keys in the properties file, as text.
        faults: The faults of the configuration.
    """
    key = f"source[{index}]"
    if what := registry.clash(connector):
        faults.add(f"{key}.connector: {what}")
        return
    try:
        known = [field.encode_name for field in msgspec.structs.fields(registry.options_type(connector))]
    except ConfigError as error:
        faults.add(f"{key}.connector: {error}")
        meant = registry.meant_by(connector)
        if meant and meant != connector:
            with suppress(ConfigError):
                known = [field.encode_name for field in msgspec.structs.fields(registry.options_type(meant))]
                for option in (*options, *texts):
                    if option not in known:
                        faults.add(unknown_option(index, option, known))
        return
    near_to = {name for option in (*options, *texts) if option not in known for name in near(option, known)}
    for option in (*options, *texts):
        if option not in known:
            faults.add(unknown_option(index, option, known))
    for fault in registry.option_faults(connector, options, texts):
        missing, _, what = fault.partition(": ")
        if missing not in near_to or what != NEEDED:
            faults.add(f"{key}.{fault}")


def _options(key: str, source: Source, faults: Faults) -> msgspec.Struct | None:
    """Return the connector's checked options; if they have faults, add these and return None."""
    before = faults.count
    note_options(int(key[7:-1]), source.connector, source.options, source.texts, faults)
    if faults.count > before:
        return None
    try:
        options = registry.convert_options(source.connector, source.options, source.texts)
    except ConfigError as error:
        faults.add(f"{key}.{error}")
        return None
    source.options, source.texts = msgspec.to_builtins(options), {}
    return options


def _filled(kind: type[msgspec.Struct], source: Source) -> msgspec.Struct | None:
    """Return the options with placeholders for missing keys; None if that leaves faults."""
    fields = msgspec.structs.fields(kind)
    known = {field.encode_name for field in fields}
    given = {key: value for key, value in (source.texts | source.options).items() if key in known}
    missing = {field.encode_name: "missing" for field in fields if field.required}
    try:
        return msgspec.convert(missing | given, kind, strict=False)
    except (msgspec.ValidationError, ConfigError):
        return None


def _recorded(key: str, source: Source, config: Config, recordings: Recordings) -> Layout:
    """Return the layout of a source that plays a recording.

    The source also gets its period and its stale age from the recording.
    """
    from shmio.connectors.replay.source import Replay, chosen, files  # noqa: PLC0415

    for name in ("layout", "block", "type_bytes", "encoding", "properties"):
        if getattr(source, name):
            raise ConfigError(
                f"{key}.{name}: leave out this key in a replay, because its registers are those of the recording"
            )
    options = msgspec.convert(source.options, Replay.Options)
    try:
        source.options["file"] = [_file(file, source, config) for file in files(options)]
        recording = recordings.get(source.options["file"])
    except (RecordingError, RemoteError) as error:
        raise ConfigError(f"{key}.file: {error}") from None
    try:
        block = chosen(recording, options, source.name)[1].block
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    source.period_ms, source.stale_ms = block.period_ns / 1e6, block.stale_ns / 1e6
    return block.layout


def _file(name: str, source: Source, config: Config) -> str:
    """Return the path of a recording; a cell's history in a fabric is first copied to a file in the folder of the logs.

    Raises:
        RecordingError: The history cannot be copied.
        RemoteError: No server of the fabric can be reached.

    """
    if not is_place(name):
        return str(config.path(name))
    from shmio.fabric.history import fetch  # noqa: PLC0415  most recordings are files

    times = source.options.get("start"), source.options.get("end")
    try:
        begin, end = (date_ns(time) if isinstance(time, str) else None for time in times)
    except ValueError:
        begin = end = None  # the replay reports the time
    digest = hashlib.sha256(repr((name, times)).encode()).hexdigest()[:16]
    file = config.log_dir / f"{source.name}.{digest}.mem"
    if not file.exists():  # so that a restart plays the same history
        config.log_dir.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.unlink(missing_ok=True)  # an earlier process ended while it fetched
        url, cell = parse_place(name)
        fabric = config.fabric
        access = Access((url,))
        # An embedded server has files of its own, which other servers may know, and asks for no credentials.
        if fabric is not None and (not fabric.embedded or url.startswith("tls:")):
            access = Access((url,), fabric.tls, fabric.credentials)
        fetch(Place(access, cell), part, begin, end)
        part.replace(file)
    return str(file)


def _mirrored(key: str, source: Source, config: Config, files: LayoutFiles) -> Layout:
    """Return the layout of a source that mirrors another cell's source.

    It comes from the registry, with the period and the stale age. If the configuration names files,
    they have the layout, also while the registry does not know it.
    """
    from shmio.connectors.fabric.source import CACHE, Mirror, offered  # noqa: PLC0415

    if config.fabric is None:
        raise ConfigError(f"{key}.connector: a mirror needs a table [fabric] with the server's address")
    try:
        mirror = Mirror(msgspec.convert(source.options, Mirror.Options), source.name)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    if str(mirror.cell) == config.fabric.cell:
        raise ConfigError(f"{key}.cell: {mirror.cell} is this instance; name the cell of another instance")
    own = None if source.layout is None else files.get(key, source, None)
    file = config.log_dir / CACHE.format(source.name)
    try:
        offer, old = offered(mirror, Access.of(config.fabric), file)
    except ConfigError as error:
        if own is None:
            raise ConfigError(f"{key}.{error}") from None
        files.odd.append(f"{key}.{error}; until then, nothing checks that the owner has the layout in {key}.layout")
        return own
    if own is not None and source.encoding is None and _bytes_of(own) == _bytes_of(offer.layout):
        own = offer.layout  # the owner knows the encoding
    if own is not None and not old and own.hash != offer.layout.hash:
        raise ConfigError(
            f"{key}.layout: {mirror} has another layout; use the owner's file, or remove this key: then the mirror "
            "has the owner's layout"
        )
    if old and own is None:
        files.odd.append(f"{key}.cell: the layout of {mirror} is the one that {file} has kept: {old}")
    source.period_ms, source.stale_ms = offer.period_ns / 1e6, source.stale_ms or offer.stale_ns / 1e6
    return own or offer.layout


def _bytes_of(layout: Layout) -> bytes:
    """Return the hash of a layout without the encodings of its texts."""
    return layout.with_encoding(ISO_8859_1).hash


def _model(key: str, source: Source, config: Config, files: LayoutFiles) -> tuple[Layout, tuple[str, ...]]:
    """Return the layout of a simulation's block, from files or from its model, and the paths of its inputs."""
    from shmio.connectors.models.simulation import Simulation  # noqa: PLC0415  loads numpy

    source.options["folder"] = str(config.path(source.options["folder"]))
    layout = None if source.layout is None else files.get(key, source, None)
    found, inputs, notices = describe(key, msgspec.convert(source.options, Simulation.Options), layout)
    files.odd += [f"{key}.model: {notice}" for notice in notices]
    return found.with_encoding(encoding_of(key, source, table=True)) if layout is None else found, inputs


def describe(
    key: str, options: Simulation.Options, layout: Layout | None, name: str = "model"
) -> tuple[Layout, tuple[str, ...], tuple[str, ...]]:
    """Return the layout of a model's block, the paths of its inputs, and what the user should know.

    A separate process imports the model.

    Args:
        key: The section in the configuration, for messages.
        options: The model, its parameters and its folder.
        layout: The layout of the block; None if the model's declarations define the layout.
        name: The key in the section whose value is the model.

    Raises:
        ConfigError: The model cannot be imported or described; the message begins with ``key``.

    """
    from shmio.connectors.models.simulation import Answer, Request  # noqa: PLC0415  loads numpy

    request = Request(options, None if layout is None else layout.to_json().decode())
    command = [sys.executable, "-P", "-m", "shmio.connectors.models.simulation"]
    try:
        done = subprocess.run(
            command, input=msgspec.json.encode(request), capture_output=True, timeout=PATIENCE_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{key}.{name}: importing {options.model} takes more than {PATIENCE_S:g} s") from None
    try:
        answer = msgspec.json.decode(done.stdout, type=Answer)
    except msgspec.MsgspecError:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise ConfigError(
            f"{key}.{name}: the process that imports {options.model} ended with status {done.returncode}: {last}"
        ) from None
    if answer.error:
        text = f"{name}: {answer.error[7:]}" if answer.error.startswith("model: ") else answer.error
        raise ConfigError(f"{key}.{text}")
    return load_layout(answer.layout.encode()), answer.inputs, answer.notices


def _check_connections(
    key: str,
    source: str,
    connections: Mapping[str, str],
    inputs: tuple[str, ...],
    layouts: Mapping[str, Layout],
) -> None:
    """Check that each connection goes from a register of a source to an input that fits it.

    Raises:
        ConfigError: A connection is invalid.

    """
    for path, topic in connections.items():
        try:
            _check_connection(source, path, topic, inputs, layouts)
        except ShmioError as error:
            raise ConfigError(f"{key}.connections.{path}: {error}") from None


def _check_connection(
    source: str, path: str, text: str, inputs: tuple[str, ...], layouts: Mapping[str, Layout]
) -> None:
    if path not in inputs:
        raise PathError(unknown("input", path, inputs, "the model"))
    topic = parse_topic(text, layouts, source)
    if topic.source not in layouts:
        raise PathError(f"{text}: {unknown('source', topic.source, layouts)}")
    if topic.direction == "in":
        raise PathError(f"{text}: an input reads an output of a source; leave out /in")
    register, own = look_up(layouts[topic.source], topic), find(layouts[source], path)
    value = codec(register).decode(bytes(layouts[topic.source].size))
    try:
        codec(own).encode_into(value, initial_frame(layouts[source])[0])
    except ValueRangeError:
        kinds = [f"{kind.type}{'[]' * len(kind.dims)}" for kind in (own, register)]
        raise ValueRangeError(f"{text} is {kinds[1]}, which does not fit an input of {kinds[0]}") from None
