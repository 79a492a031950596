"""The sections of ``supervisor.toml`` as types; docs/reference/config.md explains each key."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, field

Text = Annotated[str, Meta(min_length=1)]
Texts = Annotated[list[Text], Meta(min_length=1)]

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}\Z"
NAME_RULE = "at most 40 letters, digits and _ . -, the first a letter or a digit"
Name = Annotated[str, Meta(pattern=NAME_PATTERN)]
Milliseconds = Annotated[float, Meta(gt=0, le=3_600_000)]
DbNumber = Annotated[int, Meta(ge=1, le=65535)]
Seconds = Annotated[float, Meta(ge=0, le=1e9)]
Operand = bool | int | float | str | list[Any]
LogFormat = Literal["text", "json"]
ClockName = Literal["wall", "stepped"]
EmulatorClockName = Literal["wall", "instance"]
ReplayedInjections = Literal["keep", "leave out"]
DistributionName = Literal["uniform", "gaussian"]
OperationName = Literal["set", "offset", "scale", "clamp", "noise", "random", "freeze", "delay", "drop", "flip"]
BrokerName = Literal["embedded", "mosquitto", "external"]
PayloadName = Literal["text", "json", "structure", "frames"]
ProcessState = Literal["starting", "running", "backoff", "stopped", "fatal"]
QualityName = Literal["bad", "uncertain", "good"]
Severity = Literal["info", "warning", "critical"]
JointTypeName = Literal["revolute", "prismatic"]
FormName = Literal["box", "cylinder", "sphere"]
AlongName = Literal["x", "y", "z"]
UnitName = Literal["deg", "rad", "mm", "m"]
TypeBytes = Annotated[dict[Text, Annotated[int, Meta(ge=1, le=1 << 20)]], Meta(max_length=1000)]
"""Sizes in bytes of types whose members are unknown, by type name."""
RealtimePriority = Annotated[int, Meta(ge=1, le=99)]
"""Priority under the scheduling policy SCHED_FIFO (sched(7))."""

ROLES = ("read", "write", "inject", "control")
"""The roles (permissions) that clients of the gRPC endpoint can have."""


class Section(Struct, forbid_unknown_fields=True, kw_only=True):
    """Base class of the tables of a configuration file; a table refuses unknown keys."""


class Instance(Section):
    """``[instance]``: settings for all processes."""

    name: Name
    log_dir: Text = "logs"
    snapshot_dir: Text = "snapshots"
    log_format: LogFormat = "text"
    audit: bool = True
    audit_mb: Annotated[float, Meta(ge=0.01, le=65536)] = 10.0
    audit_files: Annotated[int, Meta(ge=1, le=1000)] = 20
    group: Text | None = None
    ring_mb: Annotated[float, Meta(gt=0, le=65536)] = 64.0
    clock: ClockName = "wall"


class Source(Section):
    """``[[source]]``: a producer of registers.

    ``options`` has the values of the connector's own keys in the table. ``texts`` has those of the
    keys in the ``properties`` file that the table does not override, still as text. Both are checked
    later, against the types of the connector's options.
    """

    name: Name
    connector: Text
    layout: Text | Texts | None = None
    tags: Text | Texts | None = None
    block: Text | None = None
    type_bytes: TypeBytes = {}
    encoding: Text | None = None
    properties: Text | None = None
    period_ms: Annotated[float, Meta(ge=0.1, le=3_600_000)] = 20.0
    stale_ms: Milliseconds | None = None
    writable: list[Text] = []
    allow_nonfinite: tuple[Text, ...] = ()
    armed: bool = False
    realtime_priority: RealtimePriority | None = None
    options: dict[str, Any] = {}
    texts: dict[str, str] = {}

    @property
    def period_ns(self) -> int:
        """Time between two cycles, in ns."""
        return round(self.period_ms * 1_000_000)

    @property
    def stale_ns(self) -> int:
        """Age in ns above which a frame is bad: as configured; by default, 5 periods, but at least 500 ms."""
        return round(1_000_000 * (self.stale_ms or max(5 * self.period_ms, 500.0)))


class Emulator(Section):
    """``[[emulator]]``: a process that emulates a controller."""

    name: Name
    kind: Text
    listen: Text
    layout: Text | Texts | None = None
    program: Text = "idle"
    parameters: dict[str, Any] = {}
    folder: Text = "."
    clock: EmulatorClockName = "wall"
    profile: Text | None = None
    faults: bool = False
    block: Text | None = None
    type_bytes: TypeBytes = {}
    encoding: Text | None = None
    dbNumber: DbNumber | None = None  # noqa: N815 - named as the source's
    insecure: bool = False
    realtime_priority: RealtimePriority | None = None


class Tls(Section):
    """``[grpc.tls]``: PEM files of the gRPC endpoint.

    With ``client_ca``, clients must present a certificate that this authority has issued.
    """

    certificate: Text
    key: Text
    client_ca: Text | None = None


class Token(Section):
    """``[[grpc.token]]``: a bearer token, given by a file or a hash, and the roles of its bearer."""

    name: Name
    roles: Texts
    token_file: Text | None = None
    sha256: Text | None = None


class Client(Section):
    """``[[grpc.client]]``: the roles of clients with a certificate whose name matches a pattern."""

    subject: Text | Texts
    roles: Texts

    @property
    def patterns(self) -> list[str]:
        """Globs, one of which must match the common name or an alternative name of the certificate."""
        return [self.subject] if isinstance(self.subject, str) else self.subject


class Listening(Section):
    """``[[grpc.address]]``: an address to listen on, and the roles of its clients without token or certificate."""

    listen: Text
    roles: Texts = field(default_factory=lambda: ["read"])
    insecure: bool = False
    tokens_in_plain_text: bool = False


class Grpc(Section):
    """``[grpc]``: the endpoint that serves remote programs."""

    listen: list[Text] = []
    default_source: Text | None = None
    insecure: bool = False
    tokens_in_plain_text: bool = False
    tls: Tls | None = None
    token: list[Token] = []
    client: list[Client] = []
    address: list[Listening] = []

    @property
    def guarded(self) -> bool:
        """True if the addresses of ``listen`` require a token or a client certificate."""
        return bool(self.token or self.client)

    @property
    def listening(self) -> dict[str, Listening]:
        """All addresses to listen on, by configuration key, with the roles of unauthenticated clients.

        At the addresses of ``listen``, such clients have all roles; none if the endpoint is
        ``guarded``.
        """
        roles = [] if self.guarded else list(ROLES)
        found = {
            f"grpc.listen[{index}]": Listening(
                listen=text,
                roles=roles,
                insecure=self.insecure and self.tls is None,
                tokens_in_plain_text=self.tokens_in_plain_text,
            )
            for index, text in enumerate(self.listen)
        }
        return found | {f"grpc.address[{index}].listen": address for index, address in enumerate(self.address)}


class Trigger(Section):
    """``[recorder.trigger]``: records only the time around the moments at which a condition is true."""

    when: Text
    before_s: Annotated[float, Meta(ge=0, le=3600)] = 10.0
    after_s: Annotated[float, Meta(ge=0, le=86_400)] = 10.0
    before_mb: Annotated[float, Meta(gt=0, le=65536)] = 64.0


class Recorder(Section):
    """``[recorder]``: the process that records the instance to ``.mem`` files."""

    directory: Text = "dumps"
    fsync_s: Annotated[float, Meta(ge=0, le=3600)] = 0.0
    buffer_mb: Annotated[float, Meta(gt=0, le=65536)] = 16.0
    rotate_min: Annotated[float, Meta(ge=0, le=100_000)] = 60.0
    rotate_mb: Annotated[float, Meta(ge=0, le=1e9)] = 1000.0
    keep_days: Annotated[float, Meta(ge=0, le=100_000)] = 0.0
    keep_mb: Annotated[float, Meta(ge=0, le=1e9)] = 0.0
    sources: list[Text] = []
    registers: Annotated[list[Text], Meta(max_length=1000)] = []
    trigger: Trigger | None = None

    @property
    def buffer_bytes(self) -> int:
        """Maximum number of bytes that may wait in memory while the disk is slow or full."""
        return round(self.buffer_mb * 1e6)


class Replay(Section):
    """``[replay]``: the recording that replaces the sources in the mode ``replay``."""

    file: Text | Texts | None = None
    start: float | Text | None = None
    end: float | Text | None = None
    speed: Annotated[float, Meta(ge=0.01, le=1000)] = 1.0
    loop: bool = False
    paused: bool = False
    injections: ReplayedInjections = "keep"
    record: bool = False


class Declaration(Section, omit_defaults=True):
    """``[[injection]]``: an injection that the process of its source runs.

    docs/reference/injections.md describes the keys. ``declaration.py`` has the rules for the keys
    of each operation.
    """

    name: Name
    target: Text | Annotated[list[Text], Meta(min_length=1, max_length=64)]
    operation: OperationName
    value: Operand | None = None
    values: Annotated[list[Any], Meta(min_length=1, max_length=256)] | None = None
    min: float | None = None
    max: float | None = None
    amplitude: Annotated[float, Meta(gt=0, le=1e300)] | None = None
    distribution: DistributionName | None = None
    delay_ms: Milliseconds | None = None
    delay_cycles: Annotated[int, Meta(ge=1)] | None = None
    bits: Annotated[list[Annotated[int, Meta(ge=0)]], Meta(min_length=1, max_length=64)] | None = None
    probability: Annotated[float, Meta(gt=0, le=1)] | None = None
    start_s: Seconds | None = None
    end_s: Seconds | None = None
    when: Text | None = None
    for_s: Annotated[float, Meta(gt=0, le=1e9)] | None = None
    times: Annotated[int, Meta(ge=1)] | None = None
    priority: Annotated[int, Meta(ge=-(2**31), lt=2**31)] = 0
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] | None = None


class Expectation(Section, omit_defaults=True):
    """``[[expect]]``: what a campaign expects of signals.

    docs/reference/expectations.md describes the keys. ``expectation.py`` has the rules for the keys
    of each form.
    """

    name: Name
    formula: Text | None = None
    when: Text | None = None
    within_s: Seconds | None = None
    then: Text | None = None
    never: Text | None = None
    always: Text | None = None
    stays: Text | None = None
    for_s: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    signal: Text | Annotated[list[Text], Meta(min_length=1, max_length=64)] | None = None
    max_rate: Annotated[float, Meta(ge=0, le=1e300)] | None = None
    like: Text | None = None
    tolerance: Annotated[float, Meta(ge=0, le=1e300)] | None = None
    tolerance_s: Annotated[float, Meta(ge=0, le=1e6)] | None = None
    severity: Severity = "warning"
    text: Annotated[str, Meta(max_length=2000)] = ""
    requirement: Annotated[str, Meta(max_length=200)] = ""


class MqttTls(Section):
    """``[mqtt.tls]``: PEM files for MQTT.

    ``ca`` has the authority that issues the peer's certificates. Without it, an authority that the
    host trusts must have issued the certificate of an external broker. ``certificate`` and ``key``
    identify shmio to an external broker, or shmio's own broker to its clients.
    """

    ca: Text | None = None
    certificate: Text | None = None
    key: Text | None = None


class MqttTopic(Section):
    """``[[mqtt.topic]]``: a rule for how the registers that match it are published.

    The first rule that matches a register applies to it.
    """

    match: Text | Texts
    publish: bool = True
    payload: PayloadName = "text"
    qos: Annotated[int, Meta(ge=0, le=1)] = 1
    retain: bool = True
    deadband: Annotated[float, Meta(ge=0, le=1e300)] = 0.0
    max_rate_hz: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    elements: bool = False

    @property
    def patterns(self) -> list[str]:
        """Globs for paths that begin with the name of the source."""
        return [self.match] if isinstance(self.match, str) else self.match


class Sparkplug(Section):
    """``[mqtt.sparkplug]``: publishes the instance as a Sparkplug B edge node.

    ``node`` is the name of the edge node; None: the name of the instance.
    """

    group: Text
    node: Text | None = None
    primary_host: Text | None = None
    datatypes: bool = True
    elements: bool = False
    max_rate_hz: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    match: Text | Texts = "**"

    @property
    def patterns(self) -> list[str]:
        """Globs that select the metrics; they are matched against paths that begin with the source's name."""
        return [self.match] if isinstance(self.match, str) else self.match


class MqttAccount(Section):
    """``[[mqtt.account]]``: the roles of an account of shmio's own broker.

    Without ``name``, the section applies to clients without an account. ``publish`` has filters of
    topics on which an account with the role ``write`` may publish, in addition to commands.
    """

    roles: Texts
    name: Text | None = None
    publish: list[Text] = []


class Mqtt(Section):
    """``[mqtt]``: the bridge to a broker, and shmio's own broker unless ``broker`` is ``external``."""

    broker: BrokerName = "embedded"
    listen: Text | None = None
    host: Text | Texts | None = None
    port: Annotated[int, Meta(ge=1, le=65535)] | None = None
    prefix: Text | None = None
    insecure: bool = False
    tls: MqttTls | None = None
    username: Text | None = None
    password_file: Text | None = None
    client_id: Annotated[str, Meta(min_length=1, max_length=128)] | None = None
    keep_alive_s: Annotated[int, Meta(ge=5, le=3600)] = 30
    session_expiry_s: Annotated[int, Meta(ge=0, le=2**32 - 2)] = 0
    backlog_mb: Annotated[float, Meta(ge=0, le=65536)] = 16.0
    account: list[MqttAccount] = []
    topic: list[MqttTopic] = []
    sparkplug: Sparkplug | None = None


class OpcUa(Section):
    """``[opcua]``: the endpoint that serves the instance as an OPC UA address space."""

    listen: Text
    insecure: bool = False
    certificate: Text | None = None
    key: Text | None = None
    trusted: list[Text] = []
    anonymous: list[Text] | None = None
    account: list[Token] = []
    client: list[Client] = []


class FabricRule(Section):
    """``[[fabric.rule]]``: which frames of matching sources the uplink publishes.

    The first rule that matches a source applies. ``registers`` are globs for the registers to
    publish; without them, all are published. With ``send = "changes"``, frames without a change of
    these registers are left out.
    """

    match: Text | Texts
    send: Literal["frames", "changes", "nothing"] = "frames"
    max_rate_hz: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    registers: Annotated[list[Text], Meta(max_length=1000)] = []

    @property
    def patterns(self) -> list[str]:
        """Globs for the names of sources."""
        return _listed(self.match)


class FabricAllow(Section):
    """``[[fabric.allow]]``: what the programs of other cells may do; without it, they may only read.

    ``sender`` are globs for the names of cells.
    """

    sender: Text | Texts
    roles: Texts

    @property
    def patterns(self) -> list[str]:
        """Globs for the names of the cells that send commands."""
        return _listed(self.sender)


class FabricHistory(Section):
    """``[fabric.history]``: the stream in which the servers keep what the cell publishes."""

    keep_days: Annotated[float, Meta(gt=0, le=100_000)] = 7.0
    keep_mb: Annotated[float, Meta(gt=0, le=1e9)] = 1000.0
    replicas: Annotated[int, Meta(ge=1, le=5)] = 1


class Fabric(Section):
    """``[fabric]``: the connection to the NATS servers that join instances on many hosts.

    With ``cell``, the instance is published under this name. Sources with ``connector = "fabric"``
    use the same connection. ``listen``, ``directory`` and ``store_mb`` are for the embedded server.
    """

    server: Text | Texts
    cell: Text | None = None
    listen: Text | None = None
    directory: Text = "fabric"
    store_mb: Annotated[float, Meta(gt=0, le=1e9)] | None = None
    insecure: bool = False
    tls: MqttTls | None = None
    credentials: Text | None = None
    backlog_mb: Annotated[float, Meta(ge=0, le=65536)] = 16.0
    rule: list[FabricRule] = []
    allow: list[FabricAllow] = []
    history: FabricHistory | None = None

    @property
    def embedded(self) -> bool:
        """True if the instance runs the server."""
        return self.server == "embedded"

    @property
    def servers(self) -> list[str]:
        """URLs of the servers of others; empty if the server is embedded."""
        return [] if self.embedded else _listed(self.server)


class Metrics(Section):
    """``[metrics]``: the address at which Prometheus can read the figures of the instance.

    ``roles`` has the roles of clients without a token. ``token_file`` has a token that gives the role
    ``read`` at this address alone.
    """

    listen: Text
    insecure: bool = False
    certificate: Text | None = None
    key: Text | None = None
    hosts: Annotated[list[Text], Meta(max_length=100)] = []
    registers: Annotated[list[Text], Meta(max_length=1000)] = []
    roles: Annotated[list[Text], Meta(max_length=len(ROLES))] | None = None
    token_file: Text | None = None


class Web(Metrics):
    """``[web]``: the address of the web page, which also serves the figures of ``[metrics]``.

    Users with a token have the roles in ``[[grpc.token]]``. ``scene`` is the file that describes the
    cell in 3D (``scene.py``).
    """

    scene: Text | None = None


class Alert(Section):
    """``[[alert]]``: what to watch, and whom to notify.

    An alert watches a condition over registers (``when``), the state of processes, or the quality of
    sources.
    """

    name: Name | None = None
    when: Text | None = None
    process: Text | Texts | None = None
    state: ProcessState | Annotated[list[ProcessState], Meta(min_length=1)] | None = None
    source: Text | Texts | None = None
    quality: QualityName | Annotated[list[QualityName], Meta(min_length=1)] | None = None
    for_s: Seconds = 0.0
    every_s: Annotated[float, Meta(ge=0.1, le=1e9)] = 60.0
    resolved: bool = False
    severity: Severity = "warning"
    text: Annotated[str, Meta(max_length=1000)] = ""
    command: Annotated[list[Text], Meta(min_length=1, max_length=100)] | None = None
    command_timeout_s: Annotated[float, Meta(gt=0, le=3600)] = 10.0
    mqtt_topic: Text | None = None
    mqtt_retain: bool = False
    webhook: Text | None = None
    webhook_header_file: Text | None = None
    webhook_ca: Text | None = None
    webhook_timeout_s: Annotated[float, Meta(gt=0, le=300)] = 10.0
    insecure: bool = False

    @property
    def title(self) -> str:
        """The name of the alert; if it has no name, a text that says what it watches."""
        return self.watches if self.name is None else self.name

    @property
    def watches(self) -> str:
        """The condition, the processes or the sources that the alert watches, as text."""
        what = f"process {', '.join(self.processes)}" if self.processes else f"source {', '.join(self.sources)}"
        return self.when or what

    @property
    def processes(self) -> list[str]:
        """Patterns for the names of the processes whose state the alert watches."""
        return _listed(self.process)

    @property
    def states(self) -> list[str]:
        """The states of a watched process in which the alert is active."""
        return _listed(self.state) or ["backoff", "fatal"]

    @property
    def sources(self) -> list[str]:
        """Patterns for the names of the sources whose quality the alert watches."""
        return _listed(self.source)

    @property
    def qualities(self) -> list[str]:
        """The qualities of a watched source with which the alert is active."""
        return _listed(self.quality) or ["bad"]


def _listed(value: str | list[Any] | None) -> list[str]:
    return [value] if isinstance(value, str) else value or []


class Config(Section):
    """The whole configuration. Its paths are relative to ``folder``."""

    instance: Instance
    source: list[Source] = []
    emulator: list[Emulator] = []
    injection: list[Declaration] = []
    grpc: Grpc | None = None
    mqtt: Mqtt | None = None
    opcua: OpcUa | None = None
    fabric: Fabric | None = None
    metrics: Metrics | None = None
    web: Web | None = None
    recorder: Recorder | None = None
    replay: Replay | None = None
    alert: list[Alert] = []
    folder: str = "."

    def path(self, text: str) -> Path:
        """Return the absolute path of a path in the configuration."""
        return (Path(self.folder) / text).resolve()

    @property
    def log_dir(self) -> Path:
        """Folder of the log files."""
        return self.path(self.instance.log_dir)

    @property
    def snapshot_dir(self) -> Path:
        """Folder of the snapshots."""
        return self.path(self.instance.snapshot_dir)
