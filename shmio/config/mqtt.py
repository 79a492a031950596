"""Checks the section ``[mqtt]``: the broker's address, the roles of its accounts, and the names of topics."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final
from unicodedata import category

from shmio.config.address import Address
from shmio.config.model import Config, Mqtt, MqttTopic
from shmio.errors import ConfigError
from shmio.wording import already_named, unknown

PORT: Final = 1883
TLS_PORT: Final = 8883
MAX_PREFIX: Final = 256
ROLES: Final = ("read", "write")
"""Roles of accounts of shmio's own broker: with ``read``, they may subscribe; with ``write``, publish commands."""
_ELSEWHERE: Final = ("host", "port", "username")
"""Keys that are only for an external broker: its address, and shmio's user name there."""


def check_mqtt(config: Config) -> None:
    """Check the addresses, plain-text access and combinations of keys in ``[mqtt]``.

    Raises:
        ConfigError: A key breaks a rule, or contradicts another key.

    """
    mqtt = config.mqtt
    if mqtt is None:
        return
    if mqtt.prefix is not None:
        _check_prefix(mqtt.prefix)
    for index, rule in enumerate(mqtt.topic):
        _check_topic(f"mqtt.topic[{index}]", rule)
    if mqtt.sparkplug is not None:
        for key in ("group", "node", "primary_host"):
            if (name := getattr(mqtt.sparkplug, key)) is not None:
                _check_level(f"mqtt.sparkplug.{key}", name)
    if mqtt.broker == "external":
        _check_external(mqtt)
    else:
        _check_own(mqtt)
        _check_accounts(mqtt, config.instance.name)


def own_topics(mqtt: Mqtt, instance: str) -> list[str]:
    """Return topic filters that match everything that the instance publishes, and its commands."""
    found = [f"{mqtt.prefix or f'shmio/{instance}'}/#"]
    if mqtt.sparkplug is not None:
        found.append(f"spBv1.0/{mqtt.sparkplug.group}/+/{mqtt.sparkplug.node or instance}/#")
    return found


def resolve_mqtt(mqtt: Mqtt, config: Config) -> None:
    """Make the paths in ``[mqtt]`` absolute, and set the prefix if it is not given."""
    mqtt.prefix = mqtt.prefix or f"shmio/{config.instance.name}"
    if mqtt.password_file is not None:
        mqtt.password_file = str(config.path(mqtt.password_file))
    if mqtt.tls:
        for field in ("ca", "certificate", "key"):
            if name := getattr(mqtt.tls, field):
                setattr(mqtt.tls, field, str(config.path(name)))


def brokers(mqtt: Mqtt) -> list[Address]:
    """Return the addresses of the external brokers, in the order in which to try them.

    Raises:
        ConfigError: An address is invalid.

    """
    port = mqtt.port or (PORT if mqtt.tls is None else TLS_PORT)
    hosts = [mqtt.host] if isinstance(mqtt.host, str) else mqtt.host or []
    found = []
    for index, host in enumerate(hosts):
        try:
            if "/" in host or " " in host:
                raise ConfigError(f"{host!r}: write the host's name or address, or host:port, and nothing else")
            found.append(Address.parse(host if _has_port(host) else f"{host}:{port}"))
        except ConfigError as error:
            key = "mqtt.host" if isinstance(mqtt.host, str) else f"mqtt.host[{index}]"
            raise ConfigError(f"{key}: {error}") from None
    return found


def _has_port(host: str) -> bool:
    return re.search(r"(^|\]|[^:\]]):[0-9]+\Z", host) is not None and (host.count(":") == 1 or "]" in host)


def _is_no_text(part: str) -> bool:
    """Return whether a text contains characters that brokers refuse in topics (MQTT 5.0, 1.5.4)."""
    return any(category(one) == "Cc" or 0xFDD0 <= ord(one) <= 0xFDEF or ord(one) & 0xFFFE == 0xFFFE for one in part)


def _check_level(key: str, name: str) -> None:
    if len(name) > MAX_PREFIX or set("/+#").intersection(name) or _is_no_text(name):
        raise ConfigError(
            f"{key}: {name!r} cannot be a part of a topic; write at most {MAX_PREFIX} characters, without control "
            "characters and without / + #"
        )


def _check_prefix(prefix: str) -> None:
    bad = prefix.startswith("$") or "" in prefix.split("/") or set("+#").intersection(prefix)
    if bad or len(prefix) > MAX_PREFIX or _is_no_text(prefix):
        raise ConfigError(
            f"mqtt.prefix: a topic cannot begin with {prefix!r}; write at most {MAX_PREFIX} characters, such as "
            "shmio/a50, without control characters, + and #, without $ at the beginning, / at the ends and //"
        )


def _check_topic(key: str, rule: MqttTopic) -> None:
    if rule.payload in ("structure", "frames"):
        for name in ("deadband", "elements"):
            if getattr(rule, name):
                raise ConfigError(
                    f'{key}.{name}: this key is only for single registers, not for payload = "{rule.payload}"'
                )


def _check_external(mqtt: Mqtt) -> None:
    if mqtt.account:
        raise ConfigError("mqtt.account: an external broker has accounts of its own; remove this section")
    if mqtt.listen is not None:
        raise ConfigError(
            'mqtt.listen: shmio does not start an external broker; remove this key, or set broker = "embedded"'
        )
    if mqtt.host is None:
        raise ConfigError(
            'mqtt.host: this key is needed with broker = "external"; give the broker\'s host, host:port, or a '
            "list of these"
        )
    for address in brokers(mqtt):
        if not (address.loopback or mqtt.tls or mqtt.insecure):
            _refuse_plain_text("mqtt.host", f"shmio would send plain text over the network to {address}")
    if mqtt.password_file is not None and mqtt.username is None:
        raise ConfigError("mqtt.username: this key is needed, because mqtt.password_file contains this user's password")
    if mqtt.tls and (mqtt.tls.certificate is None) != (mqtt.tls.key is None):
        raise ConfigError("mqtt.tls: give both certificate and key, or neither")


def _check_own(mqtt: Mqtt) -> None:
    for key in _ELSEWHERE:
        if getattr(mqtt, key) is not None:
            remedy = "remove it: [[mqtt.account]] has the accounts" if key == "username" else "use listen"
            raise ConfigError(f'mqtt.{key}: this key is only for broker = "external"; with "{mqtt.broker}", {remedy}')
    if mqtt.listen is None:
        raise ConfigError(f"mqtt.listen: this key is needed, such as 127.0.0.1:{PORT}")
    try:
        address = Address.parse(mqtt.listen)
    except ConfigError as error:
        raise ConfigError(f"mqtt.listen: {error}") from None
    if not address.port:
        raise ConfigError(f"mqtt.listen: {address} has no port; the usual one is {PORT}")
    if not (address.loopback or mqtt.tls or mqtt.insecure):
        _refuse_plain_text("mqtt.listen", f"other hosts can reach {address} in plain text")
    if mqtt.tls:
        for key in ("certificate", "key"):
            if getattr(mqtt.tls, key) is None:
                raise ConfigError(
                    f"mqtt.tls.{key}: this key is needed, because the broker shows its clients a certificate"
                )


def _refuse_plain_text(key: str, why: str) -> None:
    raise ConfigError(f"{key}: {why}; add a [mqtt.tls] table, or write insecure = true in [mqtt]")


def _check_accounts(mqtt: Mqtt, instance: str) -> None:
    names: dict[str | None, str] = {}
    for index, account in enumerate(mqtt.account):
        key = f"mqtt.account[{index}]"
        if account.name in names:
            first = names[account.name]
            raise ConfigError(
                f"{key}.name: {first} has no name either, and only one account may be for clients that do not log in"
                if account.name is None
                else f"{key}.name: {already_named(account.name, first)}"
            )
        names[account.name] = key
        if account.name is not None and mqtt.password_file is None:
            raise ConfigError(
                f"{key}.name: {account.name!r} needs a password; set mqtt.password_file, and add a line for it there"
            )
        for place, role in enumerate(account.roles):
            if role not in ROLES:
                raise ConfigError(f"{key}.roles[{place}]: {unknown('role', role, ROLES)}")
        if account.publish and "write" not in account.roles:
            raise ConfigError(f"{key}.publish: this key needs the role write")
        for place, topics in enumerate(account.publish):
            _check_filter(f"{key}.publish[{place}]", topics, own_topics(mqtt, instance))


def _check_filter(key: str, topics: str, own: Sequence[str]) -> None:
    levels = topics.split("/")
    wild = any(set("+#").intersection(level) and level not in ("+", "#") for level in levels)
    if wild or "#" in levels[:-1] or topics.startswith("$") or len(topics) > MAX_PREFIX or _is_no_text(topics):
        raise ConfigError(
            f"{key}: {topics!r} is not a topic filter; write at most {MAX_PREFIX} characters, such as "
            "homeassistant/#, without $ at the beginning, + and # only as whole levels, and # only as the last"
        )
    for one in own:
        if _overlap(levels, one.split("/")):
            raise ConfigError(
                f"{key}: {topics!r} would let others publish on the instance's own topics, such as {one}; choose a "
                "narrower filter"
            )


def _overlap(one: Sequence[str], other: Sequence[str]) -> bool:
    """Return whether a topic can match both filters, which are given as lists of levels."""
    if ["#"] in (list(one[:1]), list(other[:1])):
        return True
    if not one or not other:
        return not one and not other
    return (one[0] == other[0] or "+" in (one[0], other[0])) and _overlap(one[1:], other[1:])


def check_publish_topic(key: str, topic: str, mqtt: Mqtt, config: Config) -> None:
    """Check a topic on which the instance publishes something other than its registers.

    Raises:
        ConfigError: The text is not the name of a topic, or the bridge uses this topic.

    """
    if len(topic) > MAX_PREFIX or set("+#").intersection(topic) or topic.startswith("$") or _is_no_text(topic):
        raise ConfigError(
            f"{key}: {topic!r} is not a topic; write at most {MAX_PREFIX} characters, such as plant/alerts/a50, "
            "without control characters, + and #, and without $ at the beginning"
        )
    prefix = f"{mqtt.prefix or f'shmio/{config.instance.name}'}/"
    first = topic.removeprefix(prefix).partition("/")[0] if topic.startswith(prefix) else None
    taken = {"status", "simlog", *(source.name for source in config.source)}
    if first in taken or topic.startswith("spBv1.0/"):
        raise ConfigError(f"{key}: {topic!r} is a topic of the MQTT bridge; choose another one, such as {prefix}alerts")
