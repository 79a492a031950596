"""From a checked configuration to what is started: blocks, processes, their descriptions. No I/O."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.config import Config, Mqtt
from shmio.errors import ConfigError
from shmio.layout.model import Layout
from shmio.segment import Attributes, BlockSpec, Origin, ProcessSpec, segment_size

RANKS: Final[Mapping[str, int]] = {"emulator": 0, "recorder": 0, "source": 1, "grpc": 2, "mqtt": 2}
"""Order of start by kind: what plays a device, what reads devices, what serves the readings.

The recorder is there before the sources and after them: their last frames and events are recorded, too.
"""

BROKER: Final = "broker"
"""The process of our own MQTT broker, of kind mqtt: there before the bridge, and after it, which takes leave of it."""


def rank(name: str, kind: str) -> int:
    """Place of a process in the order of start; what this version does not know is stopped last."""
    return 0 if (name, kind) == (BROKER, "mqtt") else RANKS.get(kind, 0)


MODULES: Final[Mapping[str, str]] = {
    "source": "shmio.connectors",
    "emulator": "shmio.emulators",
    "grpc": "shmio.endpoints.grpc",
    "mqtt": "shmio.endpoints.mqtt",
    "recorder": "shmio.recorder",
}
"""The module that is a process of each kind."""

RULES: Final[Mapping[str, tuple[str, ...]]] = {"grpc": ("token", "client")}
"""Keys of a section that its process takes anew while it runs, by its kind."""

MAX_PROCESSES = 200
MODES = ("live", "log", "replay")
"""What it can be started as; log: what serves others is left out; replay: a recording has the sources' places."""


@dataclass(frozen=True, slots=True)
class Job:
    """A process to run: ``config`` is its section as resolved, what the process gets.

    ``rules`` is the part of the section that it takes anew while it runs, when it is told to; None: there is none.
    """

    name: str
    kind: str
    log_file: Path
    config: dict[str, Any]
    rules: dict[str, Any] | None = None

    @property
    def rank(self) -> int:
        """Place in the order of start."""
        return rank(self.name, self.kind)

    @property
    def listening(self) -> list[str]:
        """The addresses on which it listens, as the configuration has them."""
        listen = self.config.get("listen") or ()
        texts = [listen] if isinstance(listen, str) else [*listen]
        return [*texts, *(address["listen"] for address in self.config.get("address", ()))]

    def describe(self, instance: str, epoch: int) -> bytes:
        """The JSON object that the process reads from its standard input."""
        return self._json(instance, epoch, self.config | (self.rules or {}))

    def identify(self, instance: str, epoch: int) -> bytes:
        """What of it makes another process necessary when it changes."""
        return self._json(instance, epoch, self.config)

    def _json(self, instance: str, epoch: int, config: dict[str, Any]) -> bytes:
        return msgspec.json.encode(
            {
                "instance": instance,
                "epoch": epoch,
                "name": self.name,
                "kind": self.kind,
                "log_file": str(self.log_file),
                "config": config,
            },
            order="deterministic",  # it is compared with what an earlier supervisor gave
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """An instance as it will be."""

    instance: str
    mode: str
    group: str | None
    config_file: Path
    log_dir: Path
    blocks: tuple[BlockSpec, ...]
    jobs: tuple[Job, ...]
    warnings: tuple[str, ...] = ()
    """What is odd about its configuration, a line each."""
    stepped: bool = False
    """Whether time stands from the start until somebody steps."""
    origin: Origin | None = None
    """The time of the recording that is played; None: it has its own."""

    @property
    def processes(self) -> list[ProcessSpec]:
        """The slots of the process table."""
        return [ProcessSpec(job.name, job.kind) for job in self.jobs]

    @property
    def segment_bytes(self) -> int:
        """Size of the segment."""
        return segment_size(self.blocks, len(self.jobs))


def make_plan(
    config: Config,
    layouts: Mapping[str, Layout],
    emulated: Mapping[str, Sequence[Layout]],
    *,
    config_file: Path,
    mode: str = "live",
    declared: Mapping[str, bytes] | None = None,
    warnings: Sequence[str] = (),
    computed: Collection[str] = (),
    replayed: Collection[str] = (),
    remote: Mapping[str, tuple[Sequence[str], Sequence[str]]] | None = None,
    origin: Origin | None = None,
) -> Plan:
    """Plan an instance. ``layouts``: of each source, by its name; ``emulated``: all blocks of each emulator.

    ``computed``: the sources that live on the instance's clock; ``replayed``: those of them that play a recording.
    ``remote``: patterns of outputs and in-outs of those that a program elsewhere computes, by the source's name.
    ``declared``: what the sources' processes get of the declared injections, by the source's name.
    ConfigError: too many processes.
    """
    ring_bytes = round(config.instance.ring_mb * 1e6)
    blocks = tuple(
        BlockSpec(
            source.name,
            layouts[source.name],
            source.period_ns,
            source.stale_ns,
            ring_bytes,
            Attributes(
                source.connector,
                tuple(source.writable),
                source.armed,
                source.name in computed,
                outputs=tuple((remote or {}).get(source.name, ((), ()))[0]),
                inouts=tuple((remote or {}).get(source.name, ((), ()))[1]),
                replay=source.name in replayed,
            ),
            (declared or {}).get(source.name, b""),
        )
        for source in config.source
    )
    sections: list[tuple[str, str, dict[str, Any]]] = []
    for emulator in config.emulator:
        served = [layout.to_json().decode() for layout in emulated[emulator.name]]
        sections.append((emulator.name, "emulator", msgspec.to_builtins(emulator) | {"layouts": served}))
    sections += [(source.name, "source", msgspec.to_builtins(source)) for source in config.source]
    if config.grpc and mode != "log":
        place = {"group": config.instance.group, "config_file": str(config_file.resolve())}
        sections.append(("grpc", "grpc", msgspec.to_builtins(config.grpc) | place))
    if config.mqtt and mode != "log":
        sections += _mqtt(config.mqtt)
    if config.recorder:
        paths = {"directory": config.path(config.recorder.directory), "config_file": config_file.resolve()}
        recorder = msgspec.to_builtins(config.recorder) | {key: str(path) for key, path in paths.items()}
        sections.append(("recorder", "recorder", recorder))
    if len(sections) > MAX_PROCESSES:
        raise ConfigError(f"{len(sections)} processes; an instance has at most {MAX_PROCESSES}")
    log_dir = config.log_dir
    return Plan(
        instance=config.instance.name,
        mode=mode,
        group=config.instance.group,
        config_file=config_file.resolve(),
        log_dir=log_dir,
        blocks=blocks,
        jobs=tuple(_job(name, kind, log_dir / f"{name}.log", section) for name, kind, section in sections),
        warnings=tuple(warnings),
        stepped=config.instance.clock == "stepped",
        origin=origin,
    )


def process_names(config: Config) -> list[str]:
    """Of all processes that an instance of this configuration may have, whatever its mode."""
    names = [emulator.name for emulator in config.emulator] + [source.name for source in config.source]
    names += ["grpc"] if config.grpc else []
    names += [name for name, _, _ in _mqtt(config.mqtt)] if config.mqtt else []
    return [*names, "recorder"] if config.recorder else names


def _mqtt(mqtt: Mqtt) -> list[tuple[str, str, dict[str, Any]]]:
    """The bridge, and the broker if it is ours: each gets the keys that it needs, so that it alone is replaced."""
    section = msgspec.to_builtins(mqtt)
    listen, accounts = section.pop("listen"), section.pop("account")
    if mqtt.broker == "external":
        return [("mqtt", "mqtt", section)]
    node = section["sparkplug"]
    broker = {
        "listen": listen,
        "account": accounts,
        "sparkplug": node and {key: node[key] for key in ("group", "node")},
    }
    broker |= {key: section[key] for key in ("broker", "password_file", "tls", "prefix")}
    bridge = section | {"password_file": None, "tls": None}
    return [(BROKER, "mqtt", broker), ("mqtt", "mqtt", bridge)]


def _job(name: str, kind: str, log_file: Path, section: dict[str, Any]) -> Job:
    rules = RULES.get(kind)
    if rules is None:
        return Job(name, kind, log_file, section)
    found = {key: section.pop(key) for key in rules}
    return Job(name, kind, log_file, section, {key: value for key, value in found.items() if value})
