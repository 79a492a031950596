"""The section ``[mqtt]`` as types; docs/reference/config.md explains each key."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from shmio.config.section import Section, Text, Texts

BrokerName = Literal["embedded", "mosquitto", "external"]
PayloadName = Literal["text", "json", "structure", "frames"]


class MqttTls(Section):
    """``[mqtt.tls]``: PEM files.

    ``ca`` issues the peer's certificates; without it, an external broker's certificate is checked
    with the host's authorities. ``certificate`` and ``key`` identify shmio to an external broker,
    or shmio's own broker to its clients.
    """

    ca: Text | None = None
    certificate: Text | None = None
    key: Text | None = None


class MqttTopic(Section):
    """``[[mqtt.topic]]``: how matching registers are published; the first matching rule counts."""

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
        """Globs over paths that begin with their source."""
        return [self.match] if isinstance(self.match, str) else self.match


class Sparkplug(Section):
    """``[mqtt.sparkplug]``: the instance as a Sparkplug B edge node, by default of its own name."""

    group: Text
    node: Text | None = None
    primary_host: Text | None = None
    datatypes: bool = True
    elements: bool = False
    max_rate_hz: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    match: Text | Texts = "**"

    @property
    def patterns(self) -> list[str]:
        """Globs that select the metrics, over paths that begin with their source."""
        return [self.match] if isinstance(self.match, str) else self.match


class MqttAccount(Section):
    """``[[mqtt.account]]``: the roles of an account of shmio's own broker.

    Without ``name`` it holds for clients without an account. ``publish`` has filters of the topics
    that the role ``write`` allows besides commands.
    """

    roles: Texts
    name: Text | None = None
    publish: list[Text] = []


class Mqtt(Section):
    """``[mqtt]``: the bridge to a broker, and the broker itself unless that is ``external``."""

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
