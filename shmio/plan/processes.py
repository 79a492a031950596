"""Plans the blocks and processes of a checked configuration, without I/O."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from shmio.audit.file import AuditSettings
from shmio.config import Config, Mqtt, Source
from shmio.config.address import UNIX, UnixAddress
from shmio.config.model import Fabric
from shmio.config.unix_socket import remove_left
from shmio.errors import ConfigError
from shmio.fabric.connection import Access
from shmio.layout.model import Layout
from shmio.segment import Attributes, BlockSpec, Origin, ProcessSpec, segment_size

RANKS: Final[Mapping[str, int]] = {
    "emulator": 0,
    "recorder": 0,
    "source": 1,
    "grpc": 2,
    "mqtt": 2,
    "opcua": 2,
    "web": 2,
    "fabric": 2,
    "alerts": 3,
}
"""Order in which kinds of processes start: emulators and recorder, sources, endpoints, alerts.

They stop in the opposite order. The alerts stop first, so that stopping the others raises no alert.
The recorder starts before the sources and stops after them, so that it records all their frames and
events.
"""

BROKER: Final = "broker"
"""Name of the process of shmio's own MQTT broker. Like the bridge, the process has the kind ``mqtt``.

The broker starts before the bridge and stops after it, so that the bridge can disconnect properly.
"""


NATS: Final = "nats"
"""Name of the process of the embedded NATS server; its kind is fabric. It starts first, and stops last."""

ALERTS: Final = "alerts"
"""Name of the process that sends the alerts."""


def rank(name: str, kind: str) -> int:
    """Return a process's place in the order of start; processes with higher places stop first.

    A process of a kind that this version of shmio does not know stops last.
    """
    return 0 if (name, kind) in ((BROKER, "mqtt"), (NATS, "fabric")) else RANKS.get(kind, 0)


MODULES: Final[Mapping[str, str]] = {
    "alerts": "shmio.endpoints.alerts",
    "source": "shmio.connectors",
    "emulator": "shmio.emulators",
    "fabric": "shmio.endpoints.fabric",
    "grpc": "shmio.endpoints.grpc",
    "mqtt": "shmio.endpoints.mqtt",
    "opcua": "shmio.endpoints.opcua",
    "recorder": "shmio.recorder",
    "web": "shmio.endpoints.web",
}
"""The module that each kind of process runs."""

EMULATED: Final = ("layouts", "options")
"""The keys that say what an emulator serves. Their values can change while clients are connected."""

RULES: Final[Mapping[str, tuple[str, ...]]] = {"grpc": ("token", "client"), "web": ("token", "token_file")}
"""For each kind of process, the keys of its section that the process can read again while it runs."""

AUDIT_FILE: Final = "audit.jsonl"
"""Name of the audit log's newest file, which is in the folder of the log files."""
MAX_PROCESSES = 200
MODES = ("live", "log", "replay")
"""Modes of an instance.

In the mode ``log``, no endpoints are started. In the mode ``replay``, a recording replaces the
sources. The alerts are started only in the mode ``live``.
"""


@dataclass(frozen=True, slots=True)
class Job:
    """A process to run; ``config`` is its resolved section, which the process receives.

    ``rules`` is the part of the section that the process can read again while it runs; None if
    there is no such part.
    """

    name: str
    kind: str
    log_file: Path
    config: dict[str, Any]
    rules: dict[str, Any] | None = None
    log_format: str = "text"
    audit: AuditSettings | None = None
    """The audit log, to which the process writes who did what; None if there is none."""
    connection: dict[str, Any] | None = None
    """The part of the section that says how a source connects to its device, or how an emulator listens.

    If this part stays the same, the process can adapt to other changes without a new connection.
    None if each change requires a restart of the process.
    """

    def connects_like(self, other: Job) -> bool:
        """Return whether a process that has the job ``other`` can change to this job and keep its connection."""
        same = (self.log_file, self.log_format, self.audit) == (other.log_file, other.log_format, other.audit)
        return same and self.connection is not None and self.connection == other.connection

    @property
    def rank(self) -> int:
        """The process's place in the order of start."""
        return rank(self.name, self.kind)

    @property
    def listening(self) -> list[str]:
        """The addresses at which the process listens, as configured."""
        listen = self.config.get("listen") or ()
        texts = [listen] if isinstance(listen, str) else [*listen]
        return [*texts, *(address["listen"] for address in self.config.get("address", ()))]

    def remove_sockets(self) -> None:
        """Remove the UNIX sockets of the process, which has ended: if it was killed, their files are left."""
        for text in self.listening:
            if text.startswith(UNIX):
                remove_left(UnixAddress.parse(text).path)

    def describe(self, instance: str, epoch: int) -> bytes:
        """Return the description of this job, a JSON object that the process reads from its standard input."""
        return self._json(instance, epoch, self.config | (self.rules or {}))

    def describe_again(self, instance: str, epoch: int, revision: int) -> bytes:
        """Return the description of this job that replaces the one from :meth:`describe` while the process runs.

        Args:
            instance: Name of the instance.
            epoch: Epoch of the segment.
            revision: A number other than 0, which no earlier description of the process had.

        """
        return self._json(instance, epoch, self.config | (self.rules or {}), revision=revision)

    def identify(self, instance: str, epoch: int) -> bytes:
        """Return the part of the description that can change only if the process is started again."""
        return self._json(instance, epoch, self.config)

    def _json(self, instance: str, epoch: int, config: dict[str, Any], **more: int) -> bytes:
        return msgspec.json.encode(
            {
                "instance": instance,
                "epoch": epoch,
                "name": self.name,
                "kind": self.kind,
                "log_file": str(self.log_file),
                "log_format": self.log_format,
                "audit": self.audit,
                "config": config,
                **more,
            },
            order="deterministic",  # compared with the description of an earlier supervisor
        )


@dataclass(frozen=True, slots=True)
class Plan:
    """The plan of an instance: its blocks, processes and settings."""

    instance: str
    mode: str
    group: str | None
    config_file: Path
    log_dir: Path
    blocks: tuple[BlockSpec, ...]
    jobs: tuple[Job, ...]
    warnings: tuple[str, ...] = ()
    """Warnings about the configuration, one line each."""
    stepped: bool = False
    """True if time is virtual from the start: only steps move the instance's clock."""
    origin: Origin | None = None
    """The time at which the instance's clock starts, if a recording is replayed; else None."""
    log_format: str = "text"
    audit: AuditSettings | None = None
    """The audit log, to which the processes write who did what; None if there is none."""
    snapshot_dir: Path = Path("snapshots")
    """Folder of the snapshots."""

    @property
    def processes(self) -> list[ProcessSpec]:
        """The entries of the process table."""
        return [ProcessSpec(job.name, job.kind) for job in self.jobs]

    @property
    def segment_bytes(self) -> int:
        """Size of the segment in bytes."""
        return segment_size(self.blocks, len(self.jobs))


def make_plan(
    config: Config,
    layouts: Mapping[str, Layout],
    emulated: Mapping[str, Sequence[tuple[Layout, Mapping[str, Any]]]],
    *,
    config_file: Path,
    mode: str = "live",
    declared: Mapping[str, bytes] | None = None,
    warnings: Sequence[str] = (),
    computed: Collection[str] = (),
    replayed: Collection[str] = (),
    remote: Mapping[str, tuple[Sequence[str], Sequence[str]]] | None = None,
    register_options: Mapping[str, tuple[str, Collection[str]]] | None = None,
    origin: Origin | None = None,
    recordings: Path | None = None,
    scene: Mapping[str, Any] | None = None,
) -> Plan:
    """Plan an instance.

    Args:
        config: The checked configuration.
        layouts: The layout of each source, by source name.
        emulated: All blocks and tag tables of each emulator, each with the keys of the sources that
            read it, by emulator name.
        config_file: Path of the configuration file.
        mode: ``live``, ``log`` or ``replay``.
        declared: The encoded injections for each source's process, by source name; None: none.
        warnings: Warnings about the configuration.
        computed: Names of the sources that follow the instance's clock.
        replayed: Names of those computed sources that play a recording.
        remote: For each source that a remote program computes, by source name: patterns of its
            outputs, and of the registers that are both inputs and outputs.
        register_options: For each source that can change without a new connection, by source name:
            the name of the connector's class, and the keys of ``options`` that may then change.
        origin: The time at which the instance's clock starts, if a recording is replayed; else None.
        recordings: The directory of the configured recorder, even if the recorder does not run in
            this mode; None if there is no recorder.
        scene: The description of the cell in 3D for the web page; None if there is none.

    Raises:
        ConfigError: The instance has too many processes.

    """
    log_dir, log_format, audit = config.log_dir, config.instance.log_format, audit_settings(config)
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
        more: dict[str, Any] = {"layouts": [], "options": []}
        for layout, options in emulated[emulator.name]:
            more["layouts"].append(layout.to_json().decode())
            more["options"].append(dict(options))
        more["folder"] = str(config.path(emulator.folder))
        more["snapshots"] = str(config.snapshot_dir)
        sections.append((emulator.name, "emulator", msgspec.to_builtins(emulator) | more))
    for source in config.source:
        keys: dict[str, Any] = {"snapshots": str(config.snapshot_dir)} if source.name in computed else {}
        if source.connector == "fabric" and config.fabric is not None:
            keys["fabric"] = mirror_settings(config.fabric) | {"names": _names(config, source)}
        sections.append((source.name, "source", msgspec.to_builtins(source) | keys))
    if config.grpc and mode != "log":
        place = {"group": config.instance.group, "config_file": str(config_file.resolve())}
        sections.append(("grpc", "grpc", msgspec.to_builtins(config.grpc) | place))
    if config.mqtt and mode != "log":
        sections += _mqtt(config.mqtt)
    if config.opcua and mode != "log":
        sections.append(("opcua", "opcua", msgspec.to_builtins(config.opcua)))
    if config.fabric and mode != "log":
        sections += _fabric(config, config.fabric)
    http = {"folders": _folders(config), "token": msgspec.to_builtins(config.grpc.token) if config.grpc else []}
    http["config_file"] = str(config_file.resolve())
    if config.metrics and mode != "log":
        sections.append(("metrics", "web", msgspec.to_builtins(config.metrics) | http))
    if config.web and mode != "log":
        more = http | {"recordings": recordings and str(recordings)}
        more["scene"] = scene  # in place of its path
        more["fabric"] = config.fabric and msgspec.to_builtins(Access.of(config.fabric, process=True))
        sections.append(("web", "web", msgspec.to_builtins(config.web) | more))
    if config.alert and mode == "live":
        sections.append((ALERTS, "alerts", _alerts(config, log_dir)))
    if config.recorder:
        paths = {"directory": config.path(config.recorder.directory), "config_file": config_file.resolve()}
        recorder = msgspec.to_builtins(config.recorder) | {key: str(path) for key, path in paths.items()}
        sections.append(("recorder", "recorder", recorder))
    if len(sections) > MAX_PROCESSES:
        raise ConfigError(f"there are {len(sections)} processes, but an instance has at most {MAX_PROCESSES}")
    return Plan(
        instance=config.instance.name,
        mode=mode,
        group=config.instance.group,
        config_file=config_file.resolve(),
        log_dir=log_dir,
        snapshot_dir=config.snapshot_dir,
        log_format=log_format,
        audit=audit,
        blocks=blocks,
        jobs=tuple(
            _job(name, kind, log_dir / f"{name}.log", section, log_format, audit, (register_options or {}).get(name))
            for name, kind, section in sections
        ),
        warnings=tuple(warnings),
        stepped=config.instance.clock == "stepped",
        origin=origin,
    )


def audit_settings(config: Config) -> AuditSettings | None:
    """Return the settings of the instance's audit log; None if it has none."""
    section = config.instance
    if not section.audit:
        return None
    return AuditSettings(str(config.log_dir / AUDIT_FILE), round(section.audit_mb * 1e6), section.audit_files)


def process_names(config: Config) -> list[str]:
    """Return the names of all processes that the instance may have, whatever the mode."""
    names = [emulator.name for emulator in config.emulator] + [source.name for source in config.source]
    names += ["grpc"] if config.grpc else []
    names += [name for name, _, _ in _mqtt(config.mqtt)] if config.mqtt else []
    names += ["opcua"] if config.opcua else []
    names += [name for name, _, _ in _fabric(config, config.fabric)] if config.fabric else []
    names += ["metrics"] if config.metrics else []
    names += ["web"] if config.web else []
    names += [ALERTS] if config.alert else []
    return [*names, "recorder"] if config.recorder else names


def mirror_settings(fabric: Fabric) -> dict[str, Any]:
    """Return what the process of a mirror needs to connect to the fabric, and the instance's name in it."""
    return {"access": msgspec.to_builtins(Access.of(fabric, process=True)), "cell": fabric.cell}


def _names(config: Config, mirror: Source) -> dict[str, str]:
    """Return the names at the owner of all sources that mirror the same cell as ``mirror``."""
    mirrors = [one for one in config.source if one.connector == "fabric"]
    return {
        one.name: one.options.get("source") or one.name
        for one in mirrors
        if one.options.get("cell") == mirror.options.get("cell")
    }


def _folders(config: Config) -> dict[str, str]:
    """Return the folders in which the instance writes files, by purpose."""
    folders = {"logs": str(config.log_dir)}
    if config.recorder:
        folders["recordings"] = str(config.path(config.recorder.directory))
    return folders


def _alerts(config: Config, log_dir: Path) -> dict[str, Any]:
    """Return what the alerts' process needs: the alerts, and the MQTT bridge's section if an alert publishes."""
    publishes = config.mqtt is not None and any(alert.mqtt_topic for alert in config.alert)
    bridge = _mqtt(config.mqtt)[-1][2] if config.mqtt is not None and publishes else None
    return {
        "alert": msgspec.to_builtins(config.alert),
        "mqtt": bridge,
        "log_dir": str(log_dir),
    }


def _mqtt(mqtt: Mqtt) -> list[tuple[str, str, dict[str, Any]]]:
    """Return name, kind and section of the bridge's process and, if it is shmio's own, of the broker's.

    Each section contains only the keys that its process needs. If a key changes, only that process is
    then restarted.
    """
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


def _fabric(config: Config, fabric: Fabric) -> list[tuple[str, str, dict[str, Any]]]:
    """Return name, kind and section of the embedded server's process and of the uplink's, as far as they exist."""
    found: list[tuple[str, str, dict[str, Any]]] = []
    if fabric.embedded:
        own = ("listen", "directory", "tls", "cell", "store_mb")
        server = {key: msgspec.to_builtins(getattr(fabric, key)) for key in own}
        server["cells"] = sorted({pattern for one in fabric.allow for pattern in one.patterns})
        found.append((NATS, "fabric", server))
    if fabric.cell is not None:
        keys = ("cell", "backlog_mb", "rule", "allow", "history")
        section = {key: msgspec.to_builtins(getattr(fabric, key)) for key in keys}
        section["access"] = msgspec.to_builtins(Access.of(fabric, process=True))
        if config.web is not None:
            scheme = "http" if config.web.certificate is None else "https"
            section["web"] = f"{scheme}://{config.web.listen}"
        found.append(("fabric", "fabric", section))
    return found


def _job(
    name: str,
    kind: str,
    log_file: Path,
    section: dict[str, Any],
    log_format: str,
    audit: AuditSettings | None,
    changeable: tuple[str, Collection[str]] | None,
) -> Job:
    keys = RULES.get(kind)
    rules = None if keys is None else {key: value for key in keys if (value := section.pop(key))}
    connection = None
    if changeable is not None and kind == "source":
        options = {key: value for key, value in section["options"].items() if key not in changeable[1]}
        connection = {"class": changeable[0], "options": options}
        connection |= {key: section[key] for key in ("connector", "realtime_priority")}
    if kind == "emulator":
        connection = {key: value for key, value in section.items() if key not in EMULATED}
    return Job(name, kind, log_file, section, rules, log_format, audit, connection)
