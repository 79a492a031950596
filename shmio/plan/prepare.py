"""Makes a plan from a configuration file: compiles layouts, and checks connectors and emulators.

It imports models, injections and selections only for a configuration that has them: these modules
load numpy, and no process of the instance starts before the plan is ready.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from shmio.config import Address, Alert, Config, Emulator, Mqtt, Source
from shmio.config.credentials import read_accounts
from shmio.config.faults import Faults
from shmio.config.read import examine
from shmio.config.web import http_sections
from shmio.emulators.areas import TableMemory, place_name
from shmio.emulators.device import Served
from shmio.emulators.kinds import FAULTY, KINDS, S7, create
from shmio.emulators.programs import IDLE, is_user_code
from shmio.errors import ConfigError, PathError
from shmio.layout.glob import Glob
from shmio.layout.image import initial_value_warnings
from shmio.layout.model import Layout
from shmio.layout.spelling import block_path, topic_path
from shmio.layout.topic import find, look_up, names_part, parse_topic
from shmio.layout.topic import near as near_paths
from shmio.layout.values.write import chosen
from shmio.plan.host import check_host, exposure
from shmio.plan.layouts import LayoutFiles
from shmio.plan.ports import check_listening
from shmio.plan.processes import ALERTS, Plan, make_plan, process_names
from shmio.plan.replay import Recordings, replayed
from shmio.plan.scene import check_scene
from shmio.plan.sources import check_sources, describe, note_options
from shmio.wording import did_you_mean, near, unknown

DEVICE_KEYS = ("nodes", "unit", "word_order", "byte_order", "framing")
"""Keys of a source that say how its device names or stores values."""
NONFINITE = ("REAL", "LREAL")
"""Types whose values can be NaN or infinite."""


@dataclass(frozen=True)
class Prepared:
    """A checked configuration from which an instance can be started."""

    config: Config
    plan: Plan
    layouts: dict[str, Layout]
    """The layout of each source, by source name."""
    emulated: dict[str, tuple[Served, ...]]
    """All blocks and tag tables that each emulator serves, by emulator name."""
    injections: tuple[str, ...]
    """A line about each declared injection."""
    warning: Callable[[str], str]
    """Returns a further warning with its file and line, for ``key: what is unusual``."""
    notes: tuple[str, ...] = ()
    """Remarks for the user that are not about faults."""


def prepare(
    file: Path, mode: str = "live", keys: Mapping[str, Any] | None = None, *, writes_files: bool = True
) -> Prepared:
    """Read a configuration, and check everything that can be checked without starting anything.

    Args:
        file: The configuration file.
        mode: ``live``, ``log`` or ``replay``.
        keys: Values by key that override those in the section ``[replay]``; None for none.
        writes_files: Whether the instance writes logs and recordings, so that their folders must be writable.

    Raises:
        ConfigError: The configuration has faults.
        LayoutError: A layout cannot be compiled.

    """
    config, faults, broken, names = examine(file)
    sound = not faults  # otherwise, sections may have been left out, and what follows must not miss them
    origin, notices = None, list[str]()
    if mode == "log" and config.recorder is None and not faults:
        raise ConfigError(
            f"{file}: --mode log records the sources and needs a [recorder] section; "
            'add one, such as [recorder] with directory = "dumps", or leave out --mode log'
        )
    directory = config.path(config.recorder.directory) if config.recorder else None  # a replay leaves out the recorder
    with Recordings() as recordings:
        if mode == "replay":
            faults.raise_any()
            with faults.catching():
                config, origin, notices = replayed(config, keys or {}, recordings)
            faults.raise_any()
            faults.play([source.name for source in config.source])
        files = LayoutFiles(config)
        notices += check_host(config, faults.catching, writes_files=writes_files)
        check_listening(config, faults.catching)
        known = [source.name for source in config.source]
        all_sources = mode == "replay" or names == known
        before = faults.count
        sources = check_sources(config, files, recordings, faults, all_sources=all_sources)
    places, faults.places = faults.places, {}
    for index, own in broken.items():
        note_options(index, *own, faults)
    faults.places = places
    unsure_sources = faults.count > before
    emulated: dict[str, tuple[Served, ...]] = {}
    for index, emulator in enumerate(config.emulator):
        with faults.catching():
            if emulator.layout is not None or (all_sources and not unsure_sources):  # else its readers are unknown
                emulated[emulator.name] = _check_emulator(index, emulator, config, files)
    layouts = sources.layouts
    named = known if all_sources else names
    missing = {name for name in named or () if name not in layouts or (named or []).count(name) > 1}
    whole = all_sources and not missing

    def is_unsure(text: str) -> bool:
        """Return whether a text may name a source whose registers are unknown because of another fault."""
        if whole:
            return False
        unclear = named is None or (missing and not layouts) or '"' in text  # TIA Portal's spelling needs all sources
        return bool(unclear) or any(name in text for name in missing)

    if whole:
        before = faults.count
        with faults.catching():
            config = _spelled(config, layouts)
        whole = faults.count == before
    declared, described = dict[str, bytes](), tuple[str, ...]()
    if config.injection:
        from shmio.plan.injections import check_injections  # noqa: PLC0415  loads numpy

        declared, described = check_injections(config, layouts, faults, is_unsure)
    scene = check_scene(config, layouts, faults, replayed=mode == "replay", is_unsure=is_unsure)
    if config.recorder and config.recorder.trigger and not is_unsure(config.recorder.trigger.when):
        with faults.catching():
            _check_trigger(config.recorder.trigger.when, layouts)
    for index, alert in enumerate(
        config.alert if mode != "replay" else ()
    ):  # a replay has other sources, and no alerts
        with faults.catching():
            if not is_unsure(f"{alert.when} {alert.sources}") and (sound or not alert.processes):
                _check_alert(f"alert[{index}]", alert, config, layouts)
    odd = [*notices, *files.odd] if not faults else []
    for needs, found in (
        (whole and sound, lambda: _odd(config, layouts, faults)),
        (not (whole and sound), lambda: _odd_besides(config, layouts, faults)),
        (whole, lambda: _odd_topics(config, layouts)),
        (whole, lambda: _odd_recorder(config, layouts)),
        (whole, lambda: _odd_rules(config, layouts)),
        (whole and sound and not unsure_sources, lambda: _not_served(config, layouts, emulated)),
        (sound and not unsure_sources, lambda: _not_emulated(config)),
        (True, lambda: _unread(emulated)),
    ):
        if needs:
            with faults.catching():
                odd += found()
    if faults:
        for text in odd:
            faults.warn(text)
    faults.raise_any()
    warnings = [*files.warnings, *map(faults.warning, odd)]
    plan = make_plan(
        config,
        layouts,
        emulated,
        config_file=file,
        mode=mode,
        declared=declared,
        warnings=warnings,
        computed=sources.computed,
        replayed=sources.replayed,
        remote=sources.remote,
        register_options=sources.register_options,
        origin=origin,
        recordings=directory,
        scene=scene,
    )
    open_to = None if mode == "log" else exposure(config)  # mode log has no endpoints
    return Prepared(config, plan, layouts, emulated, described, faults.warning, (open_to,) if open_to else ())


def _spelled(config: Config, layouts: dict[str, Layout]) -> Config:
    """Return the configuration with its paths in shmio's spelling; it may have them as TIA Portal spells them."""
    default = next(iter(layouts)) if len(layouts) == 1 else None

    def topics(patterns: str | list[str]) -> str | list[str]:
        if isinstance(patterns, str):
            return topic_path(patterns, layouts, default)
        return [topic_path(pattern, layouts, default) for pattern in patterns]

    sources = [_spelled_source(source, layouts[source.name]) for source in config.source]
    mqtt, recorder = config.mqtt, config.recorder
    if mqtt is not None:
        rules = [replace(rule, match=topics(rule.match)) for rule in mqtt.topic]
        sparkplug = mqtt.sparkplug and replace(mqtt.sparkplug, match=topics(mqtt.sparkplug.match))
        mqtt = replace(mqtt, topic=rules, sparkplug=sparkplug)
    if recorder is not None:
        recorder = replace(recorder, registers=topics(recorder.registers))
    injections = [replace(one, target=topics(one.target)) for one in config.injection]
    return replace(config, source=sources, mqtt=mqtt, recorder=recorder, injection=injections)


def _spelled_source(source: Source, layout: Layout) -> Source:
    """Return the source with patterns spelled as in the layout.

    Registers that a tag table makes writable are added to the key ``writable``, except for a mirror: its table
    is the owner's, which does not decide what this instance's programs may write.
    """
    patterns = dict.fromkeys(block_path(pattern, layout) for pattern in source.writable)
    tables = () if source.connector == "fabric" else layout.registers
    return replace(
        source,
        writable=[*patterns, *(one.path for one in tables if one.writable and one.path not in patterns)],
        allow_nonfinite=tuple(block_path(pattern, layout) for pattern in source.allow_nonfinite),
    )


def _odd_besides(config: Config, layouts: dict[str, Layout], faults: Faults) -> Iterator[str]:
    """Although there are faults, yield warnings about the patterns of those sources whose layout is known."""
    names = [source.name for source in config.source]
    for index, source in enumerate(config.source):
        if source.name in layouts and names.count(source.name) == 1:
            with faults.catching():
                spelled = _spelled_source(source, layouts[source.name])
                yield from _odd_patterns(f"source[{index}]", spelled, layouts[source.name], faults)


def peer(source: Source) -> str:
    """Return what a source reads: a device's URL, host:port or host; CELL/SOURCE for a mirror; "" if none is named."""
    if source.connector == "fabric" and (cell := source.options.get("cell")):
        return f"{cell}/{source.options.get('source') or source.name}"
    if url := source.options.get("url"):
        return str(url)
    host, port = source.options.get("host"), source.options.get("port")
    if isinstance(host, str) and host and isinstance(port, int):  # the connector's own check may come later
        return str(Address(host, port))
    return str(host or "")


def _check_condition(when: str, layouts: dict[str, Layout]) -> None:
    from shmio.injection.program import compile_condition  # noqa: PLC0415  loads numpy

    compile_condition(when, layouts)


def _check_trigger(when: str, layouts: dict[str, Layout]) -> None:
    try:
        _check_condition(when, layouts)
    except ConfigError as error:
        raise ConfigError(f"recorder.trigger.{error}") from None


def _check_alert(key: str, alert: Alert, config: Config, layouts: dict[str, Layout]) -> None:
    """Check that what an alert watches exists."""
    try:
        if alert.when is not None:
            _check_condition(alert.when, layouts)
        others = [name for name in process_names(config) if name != ALERTS]
        for name, patterns, known in (("process", alert.processes, others), ("source", alert.sources, list(layouts))):
            for pattern in patterns:
                if not any(map(Glob(pattern).matches, known)):
                    raise ConfigError(f"{name}: {unknown(name, pattern, known)}")
    except (ConfigError, PathError) as error:
        raise ConfigError(f"{key}.{error}") from None


def _check_emulator(index: int, emulator: Emulator, config: Config, files: LayoutFiles) -> tuple[Served, ...]:
    """Check an emulator; return the blocks and tag tables that it serves. Its program runs on the first."""
    key = f"emulator[{index}]"
    if emulator.kind not in KINDS:
        raise ConfigError(f"{key}.kind: {unknown('kind', emulator.kind, KINDS)}")
    if emulator.layout is None:
        return _check_served(key, emulator, _read_from(key, emulator, config, files), config)
    if emulator.kind != S7 and emulator.dbNumber is not None:
        raise ConfigError(f"{key}.dbNumber: only an emulator of S7 has numbers of blocks")
    if emulator.program == IDLE and emulator.block is None and emulator.dbNumber is None:
        layouts = files.all(key, emulator)
    else:
        layouts = (files.get(key, emulator, emulator.dbNumber),)
    served = [Served(layout, keys) for layout in layouts for keys in _device_keys(emulator, config)]
    return _check_served(key, emulator, served, config)


def _device_keys(emulator: Emulator, config: Config) -> list[dict[str, Any]]:
    """Return the device keys of the sources that read an emulator, without repetition; an empty dict if none reads it.

    A Modbus device needs each of them, because they may differ in the unit. The nodes of an OPC UA server are alike for
    all clients, so that a source without device keys adds nothing.
    """
    found: list[dict[str, Any]] = []
    for source in config.source:
        if _reads(source, emulator) and (keys := _keys_of(source)) not in found:
            found.append(keys)
    if emulator.kind == "opcua":
        found = [keys for keys in found if keys.get("nodes") == "siemens"]
    return found or [{}]


def _keys_of(source: Source) -> dict[str, Any]:
    return {name: source.options[name] for name in DEVICE_KEYS if name in source.options}


def _check_served(key: str, emulator: Emulator, served: Sequence[Served], config: Config) -> tuple[Served, ...]:
    """Check that an emulator can serve these layouts; return them."""
    served = [one._replace(layout=one.layout.base) for one in served]
    blocks = [one.layout for one in served if not one.layout.addressed] if emulator.kind == S7 else []
    if emulator.kind != S7:
        pass
    elif emulator.dbNumber is None:
        _check_numbers(key, blocks)
    elif not blocks:
        raise ConfigError(f"{key}.dbNumber: leave out this key, because each address of a tag table names its block")
    program = emulator.program
    if is_user_code(program):
        from shmio.connectors.models.simulation import Simulation  # noqa: PLC0415  loads numpy

        options = Simulation.Options(program, emulator.parameters, folder=str(config.path(emulator.folder)))
        describe(key, options, served[0].layout, "program")
        program = IDLE  # the user's code stays out of this process
    elif emulator.parameters:
        raise ConfigError(f"{key}.parameters: program {program} has no parameters; leave out this key")
    if emulator.faults and emulator.kind not in FAULTY:
        raise ConfigError(f"{key}.faults: only emulators of kind {' or '.join(FAULTY)} can have faults")
    try:
        listen, profile = Address("", 0), emulator.profile
        create(emulator.kind, served, program, listen, db_number=emulator.dbNumber, profile=profile)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None
    return tuple(served)


def _read_from(key: str, emulator: Emulator, config: Config, files: LayoutFiles) -> list[Served]:
    """Return the blocks and tag tables that sources read from an emulator without its own layout."""
    for name in ("block", "dbNumber", "type_bytes", "encoding"):
        if getattr(emulator, name):
            raise ConfigError(f"{key}.{name}: this key needs layout in the same section")
    blocks: dict[int | None, Layout] = {}
    tables: list[Served] = []
    for index, source in enumerate(config.source):
        if not _reads(source, emulator):
            continue
        number = source.options.get("dbNumber")
        layout = files.get(f"source[{index}]", source, number, optimized=emulator.kind != S7)
        if emulator.kind != S7 or layout.addressed:
            served = Served(layout, _keys_of(source))
            if served not in tables:
                tables.append(served)
            continue
        layout = dataclasses.replace(layout, number=number or layout.number)
        known = blocks.get(layout.number)
        if known is None or known.size < layout.size:
            blocks[layout.number] = layout
    found = [*(Served(layout) for layout in blocks.values()), *tables]
    if not found:
        listen = Address.parse(emulator.listen)
        raise ConfigError(
            f'{key}.layout: this key is needed, because no source with connector = "{emulator.kind}" reads {listen}'
        )
    if emulator.program != IDLE and len(found) > 1:
        names = ", ".join(one.layout.name for one in found)
        raise ConfigError(f"{key}.layout: this key is needed: program {emulator.program} runs on one of {names}")
    return found


def _reads(source: Source, emulator: Emulator) -> bool:
    """Return whether a source has the protocol and the address of an emulator, and so reads it."""
    listen = Address.parse(emulator.listen)
    device = peer(source)
    if "://" in device:
        device = device.partition("://")[2].partition("/")[0]
    return source.connector == emulator.kind and device == str(listen)


def _check_numbers(key: str, layouts: Sequence[Layout]) -> None:
    """Check that each block has a number. The compiler ensures that numbers are unique.

    Raises:
        ConfigError: A block has no number.

    """
    for layout in layouts:
        if layout.number is None:
            alone = (
                f'; or set block = "{layout.name}" in this section, to serve only that block'
                if len(layouts) > 1
                else ""
            )
            why = f"the data block {layout.name!r} has no number in its name"
            raise ConfigError(f"{key}.dbNumber: this key is needed, because {why}{alone}")


def _odd_rules(config: Config, layouts: dict[str, Layout]) -> Iterator[str]:
    if config.fabric is not None:
        from shmio.plan.fabric import odd_rules  # noqa: PLC0415  loads numpy

        yield from odd_rules(config, layouts)


def _odd(config: Config, layouts: dict[str, Layout], faults: Faults) -> list[str]:
    """Return warnings about settings of sources that are probably not intended; add faults for invalid patterns."""
    odd = []
    for index, source in enumerate(config.source):
        key, layout = f"source[{index}]", layouts[source.name]
        if source.connector == "remote" and config.grpc is None:
            odd.append(f"{key}.connector: no model can connect to {source.name}, because there is no [grpc] section")
        odd += _odd_patterns(key, source, layout, faults)
        number = source.options.get("dbNumber")
        if number is not None and layout.number is not None and number != layout.number:
            odd.append(f"{key}.dbNumber: the number is {number}, but the layout is that of DB{layout.number}")
    if not config.source:
        odd.append("there is no [[source]]: the instance will have no registers")
    return odd


def _odd_patterns(key: str, source: Source, layout: Layout, faults: Faults) -> Iterator[str]:
    """Yield warnings about patterns of a source that match no register; add faults for invalid patterns."""
    for name, patterns in (("writable", source.writable), ("allow_nonfinite", source.allow_nonfinite)):
        for pattern in patterns:
            try:
                if not _covers(pattern, layout):
                    yield f"{key}.{name}: {pattern!r} matches no register of {layout.name}{_near(pattern, layout)}"
                elif name == "allow_nonfinite" and not _covers(pattern, layout, NONFINITE):
                    yield f"{key}.{name}: {pattern!r} matches no REAL or LREAL of {layout.name}"
            except PathError as error:
                faults.add(f"{key}.{name}: {error}")


def _odd_topics(config: Config, layouts: dict[str, Layout]) -> Iterator[str]:
    """Yield warnings about endpoints' patterns that match nothing, and about an open broker.

    Raises:
        ConfigError: A pattern is invalid.

    """
    mqtt = config.mqtt
    if mqtt and mqtt.listen:
        yield from _odd_accounts(mqtt, Address.parse(mqtt.listen))
    for key, pattern, frames in _topics(config):
        if frames:
            if pattern not in layouts:
                raise ConfigError(
                    f"{key}: {pattern!r} is not the name of a source, but frames are published only for a whole source"
                )
            continue
        try:
            if names_part(pattern) and key.startswith("mqtt.topic"):
                _check_part(pattern, layouts)
                continue
            glob = Glob(pattern)
        except PathError as error:
            raise ConfigError(f"{key}: {error}") from None
        paths = [f"{source}/{register.path}" for source, layout in layouts.items() for register in layout.registers]
        if not any(map(glob.matches, paths)):
            meant = did_you_mean(_wider(pattern, paths, *(f"{source}/" for source in layouts)))
            yield f"{key}: {pattern!r} matches no register; {meant or 'the path of a register begins with its source'}"


def _check_part(path: str, layouts: dict[str, Layout]) -> None:
    """Check that the bit, slice or other part that the path names exists.

    Raises:
        PathError: The part does not exist.

    """
    topic = parse_topic(path, layouts, None)
    look_up(layouts[topic.source], topic)


def _odd_accounts(mqtt: Mqtt, address: Address) -> Iterator[str]:
    """Yield warnings about accounts of shmio's own broker with probably unintended permissions."""
    free = any(account.name is None and "write" in account.roles for account in mqtt.account)
    shown = mqtt.tls is not None and mqtt.tls.ca is not None
    if free and (mqtt.password_file or not (address.loopback or shown)):
        yield (
            f"mqtt.listen: anyone who reaches {mqtt.listen} may publish commands without an account; set "
            "mqtt.password_file, and give each [[mqtt.account]] with the role write a name"
        )
    if mqtt.password_file:
        named = {account.name for account in mqtt.account}
        if others := ", ".join(name for name in read_accounts(mqtt.password_file) if name not in named):
            yield (
                f"mqtt.password_file: {others} may only read; to let a client write, give its [[mqtt.account]] the "
                "role write"
            )


def _odd_recorder(config: Config, layouts: dict[str, Layout]) -> Iterator[str]:
    """Yield warnings about patterns of ``recorder.registers`` that match nothing."""
    if config.recorder is not None and config.recorder.registers:
        from shmio.recording.selection import Selection  # noqa: PLC0415  loads numpy

        for text in Selection(registers=config.recorder.registers).unmatched(layouts):
            yield f"recorder.registers: {text}"


def _topics(config: Config) -> Iterator[tuple[str, str, bool]]:
    """Yield each pattern of an endpoint with its key, and whether it selects frames."""
    if config.mqtt is not None:
        for index, rule in enumerate(config.mqtt.topic):
            for pattern in rule.patterns:
                yield f"mqtt.topic[{index}].match", pattern, rule.payload == "frames"
        if config.mqtt.sparkplug is not None:
            for pattern in config.mqtt.sparkplug.patterns:
                yield "mqtt.sparkplug.match", pattern, False
    for key, section in http_sections(config):
        for index, pattern in enumerate(section.registers):
            yield f"{key}.registers[{index}]", pattern, False


def _near(pattern: str, layout: Layout) -> str:
    names = _wider(pattern, [one.path for one in layout.registers]) if "*" in pattern else near_paths(layout, pattern)
    return f"; {did_you_mean(names)}" if names else ""


MAX_NAMES = 1_000
"""Maximum number of names to which a part of such a pattern is compared."""
MAX_TRIED = 32
"""Maximum number of patterns that are tried in place of one that matches nothing."""


def _wider(pattern: str, paths: Collection[str], *begins: str) -> list[str]:
    """Return a pattern like one that matches nothing, which matches a path: with another number of levels.

    Args:
        pattern: The pattern.
        paths: The paths that it could match.
        begins: Texts that may be missing at its begin, such as the names of sources with a slash.
    """
    parts = pattern.split("/")
    if not set(pattern) - set("*/"):  # it says nothing but the number of levels
        shorter = ("/".join(parts[at:]) for at in range(1, len(parts)))
        return next(([one] for one in (*shorter, "**") if one != pattern and any(map(Glob(one).matches, paths))), [])
    tried = [
        *("/".join([*parts[:at], "**", *parts[at + 1 :]]) for at, part in enumerate(parts) if part == "*"),
        "/".join("**" if part == "*" else part for part in parts),
        *(begin + pattern for begin in begins),
        f"**/{pattern}",
        *("/".join(parts[at:]) for at in range(1, len(parts))),
    ]
    with suppress(PathError):
        for wider in tried[:MAX_TRIED]:
            if wider != pattern and set(wider) - set("*/") and any(map(Glob(wider).matches, paths)):
                return [wider]
        for similar in _respelled(parts, paths):
            for wider in (similar, f"{similar}/*", f"{similar}/**"):
                if any(map(Glob(wider).matches, paths)):
                    return [wider]
    return []


def _respelled(parts: Sequence[str], paths: Collection[str]) -> Iterator[str]:
    """Yield the pattern with one level spelled like the names that the paths have there."""
    for at, part in enumerate(parts):
        begin = part.partition("*")[0]
        lengths = range(max(len(begin) - 1, 1), len(begin) + 2)
        levels = dict.fromkeys(names[at] for names in (path.split("/") for path in paths) if at < len(names))
        known = [name for name in levels if begin == part] or [name[:length] for name in levels for length in lengths]
        for name in near(begin, known[:MAX_NAMES]) if begin else ():
            yield "/".join([*parts[:at], name + part.removeprefix(begin), *parts[at + 1 :]])


def _not_served(config: Config, layouts: dict[str, Layout], emulated: dict[str, tuple[Served, ...]]) -> Iterator[str]:
    """Yield warnings about sources that read something that their emulator does not serve."""
    for index, source in enumerate(config.source):
        layout = layouts[source.name]
        number = source.options.get("dbNumber") or layout.number
        wanted = [f"DB{number}"] if number else []
        if source.connector == "s7" and layout.addressed:
            wanted = [place_name(place) for place in TableMemory(layout).needs]
        for emulator in config.emulator:
            if not wanted or emulator.kind != S7 or emulator.name not in emulated or not _reads(source, emulator):
                continue
            served = _served(emulator, emulated[emulator.name])
            if missing := [name for name in wanted if name not in served]:
                yield (
                    f"source[{index}]: it reads {', '.join(missing)} of emulator {emulator.name!r}, which serves only "
                    f"{', '.join(served)}"
                )


def _served(emulator: Emulator, served: Sequence[Served]) -> dict[str, None]:
    """Return the names of the blocks and areas that an emulator serves, in order."""
    names: dict[str, None] = {}
    for layout in (one.layout for one in served):
        if layout.addressed:
            names |= {place_name(place): None for place in sorted(TableMemory(layout).needs)}
        else:
            names[f"DB{emulator.dbNumber or layout.number}"] = None
    return names


def _not_emulated(config: Config) -> Iterator[str]:
    """Yield warnings about sources that read an address of this host where no emulator listens."""
    listening = {emulator.name: str(Address.parse(emulator.listen)) for emulator in config.emulator}
    for index, source in enumerate(config.source):
        device = peer(source)
        if source.connector != "s7" or not listening or device in listening.values() or ":" not in device:
            continue
        if Address.parse(device).loopback:
            places = ", ".join(f"{name} listens on {address}" for name, address in listening.items())
            yield f"source[{index}]: it reads {device}, where no [[emulator]] of this file listens: {places}"


def _unread(emulated: dict[str, tuple[Served, ...]]) -> Iterator[str]:
    """Yield warnings about initial values in layouts that the emulators do not understand."""
    for name, served in emulated.items():
        for text in (text for one in served for text in initial_value_warnings(one.layout)):
            yield f"emulator {name!r}: {text}"


def _covers(pattern: str, layout: Layout, types: Sequence[str] = ()) -> bool:
    """Return whether a pattern matches a register of these types, or a part or the container of such a register.

    Without ``types``, registers of all types count.

    Raises:
        PathError: The pattern is invalid.

    """
    if names_part(pattern):
        return any(not types or register.type in types for register in chosen(layout, pattern))
    glob = Glob(pattern)
    for register in layout.registers:
        if types and register.type not in types:
            continue
        if glob.matches(register.path):
            return True
        if register.dims and glob.matches(layout.element(register, tuple(low for low, _ in register.dims)).path):
            return True
    if "*" in pattern:
        return False
    try:
        found = find(layout, pattern)
    except PathError:
        return False
    return not types or found.type in types
