"""The keys of a source with ``connector = "mqtt"``."""

from __future__ import annotations

from typing import Annotated, Final, Literal
from urllib.parse import urlsplit

import msgspec

from shmio.config import Address

PORT: Final = 1883
TLS_PORT: Final = 8883
_Age = Annotated[int, msgspec.Meta(ge=0, le=86_400_000)]
_Text = Annotated[str, msgspec.Meta(min_length=1, max_length=4096)]
_Texts = Annotated[list[_Text], msgspec.Meta(min_length=1, max_length=100)]


class Will(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A topic that says whether a device is online.

    This is usually the topic of the device's last will.
    """

    topic: _Text
    """The topic, with a path if its payload is JSON."""
    good: _Texts = msgspec.field(default_factory=lambda: ["online", "true", "1", "on"])
    """The texts that mean that the device is online; every other text means that it is offline."""
    match: _Text | _Texts = "**"
    """Patterns of the registers that belong to the device."""

    @property
    def patterns(self) -> list[str]:
        """The patterns as a list."""
        return [self.match] if isinstance(self.match, str) else self.match


class MqttOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The broker's address, how to read and publish values, and when a value is good.

    Raises:
        ValueError: Some keys contradict each other.

    """

    url: Annotated[str, msgspec.Meta(min_length=1, max_length=1000)]
    timeout: Annotated[int, msgspec.Meta(ge=10, le=600_000)] = 4000
    """Time-out for connecting, for each answer of the broker, and for the writes of a cycle, in ms."""
    version: Literal["auto", "5", "3.1.1"] = "auto"
    """Version of MQTT. With ``auto``, the source tries version 5 first, and then 3.1.1."""
    client_id: Annotated[str, msgspec.Meta(min_length=1, max_length=128)] | None = None
    keep_alive_s: Annotated[int, msgspec.Meta(ge=5, le=3600)] = 30
    qos: Annotated[int, msgspec.Meta(ge=0, le=1)] = 1
    """QoS of the subscriptions."""
    write_qos: Annotated[int, msgspec.Meta(ge=0, le=1)] = 1
    retain: bool = False
    """True to publish written values with the retain flag."""
    max_age_ms: _Age | dict[_Text, _Age] | None = None
    """Age in ms above which a topic's last message is too old; 0: no message is ever too old.

    A single number applies to all registers; a table has a number for each pattern of registers.
    """
    will: _Text | Annotated[list[Will], msgspec.Meta(max_length=1000)] = msgspec.field(default_factory=list)
    time: _Text | None = None
    """Path of the source time in JSON payloads; ``@`` is the object that contains the value. None: the time of receipt.
    """
    quality: _Text | None = None
    """Path of the quality of values in JSON payloads. None: values are good."""
    texts: tuple[_Text, _Text] = ("false", "true")
    """The texts published for a BOOL register: the first for false, the second for true."""
    templates: Annotated[dict[_Text, str], msgspec.Meta(max_length=10_000)] = msgspec.field(default_factory=dict)
    """For each topic, the JSON document into which written values are inserted; default: an empty object."""
    rebirth: bool = True
    """True to ask Sparkplug nodes for their births."""
    max_payload_bytes: Annotated[int, msgspec.Meta(ge=100, le=1 << 24)] = 1 << 20
    """The largest payload whose values are read, in bytes."""
    username: Annotated[str, msgspec.Meta(min_length=1, max_length=256)] | None = None
    password_file: str | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    insecure: bool = False
    """True to allow unencrypted connections to other hosts."""

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        try:
            port = parts.port
        except ValueError:
            port = 0
        bare = not (parts.path.strip("/") or parts.query or parts.fragment)
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or port == 0 or "@" in parts.netloc or not bare:
            raise ValueError(f"url: expected mqtt://HOST:PORT or mqtts://HOST:PORT, without a user, found {self.url!r}")
        for name in ("ca", "certificate", "key"):
            if getattr(self, name) is not None and not self.tls:
                raise ValueError(f"{name}: this key has no effect without TLS; write url = 'mqtts://…'")
        if self.texts[0].strip().casefold() == self.texts[1].strip().casefold():
            raise ValueError("texts: the text for false and the text for true must differ")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate: give both certificate and key, or neither")
        if self.password_file is not None and self.username is None:
            raise ValueError("username: this key is needed, because password_file contains this user's password")
        if not (self.tls or self.address.loopback or self.insecure):
            raise ValueError(
                f"url: shmio would send plain text over the network to {self.address}; write mqtts:// instead, or set "
                "insecure = true"
            )

    @property
    def tls(self) -> bool:
        """True if the connection is encrypted."""
        return urlsplit(self.url).scheme == "mqtts"

    @property
    def address(self) -> Address:
        """Host and port of the broker."""
        parts = urlsplit(self.url)
        return Address(parts.hostname or "", parts.port or (TLS_PORT if self.tls else PORT))

    @property
    def wills(self) -> list[Will]:
        """The topics that say whether a device is online."""
        return [Will(topic=self.will)] if isinstance(self.will, str) else self.will
