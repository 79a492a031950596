"""``[mqtt]`` as types; what each key means is in docs/reference/config.md."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from shmio.config.section import Section, Text, Texts

BrokerName = Literal["embedded", "mosquitto", "external"]
PayloadName = Literal["text", "json", "structure", "frames"]


class MqttTls(Section):
    """``[mqtt.tls]``: PEM files. ``ca``: whose certificates are trusted, of an external broker the host's if not given.

    ``certificate`` and ``key``: what an external broker is shown, or what our own one shows its clients.
    """

    ca: Text | None = None
    certificate: Text | None = None
    key: Text | None = None


class MqttTopic(Section):
    """``[[mqtt.topic]]``: how the registers that ``match`` names are published; of several rules the first counts."""

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
    """``[mqtt.sparkplug]``: the instance as an edge node of Sparkplug B; ``node``: default the instance's name."""

    group: Text
    node: Text | None = None
    primary_host: Text | None = None
    datatypes: bool = True
    elements: bool = False
    max_rate_hz: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    match: Text | Texts = "**"

    @property
    def patterns(self) -> list[str]:
        """Globs over paths that begin with their source: what is a metric."""
        return [self.match] if isinstance(self.match, str) else self.match


class MqttAccount(Section):
    """``[[mqtt.account]]``: what an account of our own broker may do; without ``name``: who shows no account.

    ``publish``: topic filters of what ``write`` allows beside commands.
    """

    roles: Texts
    name: Text | None = None
    publish: list[Text] = []


class Mqtt(Section):
    """``[mqtt]``: the bridge to a broker, and the broker itself unless it is ``external``."""

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
