"""Checks the sections ``[[alert]]``, and makes their paths absolute."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final
from urllib.parse import SplitResult, urlsplit

from shmio.config.address import Address, check_host
from shmio.config.model import Alert, Config
from shmio.config.mqtt import check_publish_topic
from shmio.errors import ConfigError
from shmio.wording import already_named

MAX_ALERTS: Final = 100
"""Maximum number of alerts of an instance."""
MAX_URL: Final = 2000
_DEPENDENT: Final = {
    "state": "process",
    "quality": "source",
    "mqtt_retain": "mqtt_topic",
    "webhook_header_file": "webhook",
    "webhook_ca": "webhook",
    "insecure": "webhook",
}
"""For each key that needs another key in the same section: the other key."""


def alert_faults(config: Config) -> Iterator[str]:
    """Yield each fault of the alerts that can be found without layouts and without files of the host."""
    if len(config.alert) > MAX_ALERTS:
        yield f"alert: there are {len(config.alert)} alerts, but at most {MAX_ALERTS} are allowed"
        return
    seen: dict[str, int] = {}
    for index, alert in enumerate(config.alert):
        key = f"alert[{index}]"
        if sum(getattr(alert, name) is not None for name in ("when", "process", "source")) != 1:
            yield f"{key}.when: give exactly one of when, process and source, to say what the alert watches"
            continue
        first = seen.setdefault(alert.title, index)
        if first != index:
            named = alert.name is not None
            yield (
                f"{key}.name: {already_named(alert.title, f'alert[{first}]')}"
                if named
                else f"{key}.name: alert[{first}] watches the same thing; give both alerts names"
            )
        for name, needed in _DEPENDENT.items():
            if getattr(alert, name) and getattr(alert, needed) is None:
                yield f"{key}.{name}: this key is only for an alert with {needed}"
        try:
            if alert.mqtt_topic is not None:
                _check_topic(alert.mqtt_topic, config)
            if alert.webhook is not None:
                _check_webhook(alert.webhook, alert)
        except ConfigError as error:
            yield f"{key}.{error}"


def resolve_alert(alert: Alert, config: Config) -> None:
    """Make the paths of an alert absolute, except the name of a program that has no slash."""
    if alert.command and "/" in alert.command[0]:
        alert.command = [str(config.path(alert.command[0])), *alert.command[1:]]
    for field in ("webhook_header_file", "webhook_ca"):
        if name := getattr(alert, field):
            setattr(alert, field, str(config.path(name)))


def parse_webhook(url: str) -> SplitResult:
    """Check the URL of a webhook, and return its parts.

    Raises:
        ConfigError: The URL cannot be used for a webhook.

    """
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise ConfigError(
            f"webhook: this is not a URL ({error}); write one such as https://alerts.example/hooks/a50"
        ) from None
    if parts.scheme not in ("http", "https") or not parts.hostname or port == 0 or len(url) > MAX_URL:
        raise ConfigError("webhook: expected a URL such as https://alerts.example/hooks/a50")
    try:
        check_host(parts.hostname)
    except ConfigError as error:
        raise ConfigError(f"webhook: {error}") from None
    if not url.isascii() or " " in url:
        raise ConfigError("webhook: percent-encode blanks and all characters that are not ASCII")
    if parts.username is not None or parts.password is not None:
        raise ConfigError(
            "webhook: the URL must not contain a password; write a line such as Authorization: Basic … into a file, "
            "and name that file in webhook_header_file"
        )
    if parts.fragment:
        raise ConfigError(f"webhook: remove #{parts.fragment}, because a server never receives what follows a #")
    return parts


def _check_webhook(url: str, alert: Alert) -> None:
    parts = parse_webhook(url)
    loopback = Address(str(parts.hostname), parts.port or 0).loopback
    if parts.scheme == "http":
        if alert.webhook_ca is not None:
            raise ConfigError("webhook_ca: this key is only for a webhook with https")
        if not loopback and not alert.insecure:
            raise ConfigError(
                f"webhook: shmio would send plain text over the network to {parts.hostname}; use https, or write "
                "insecure = true in this section"
            )


def _check_topic(topic: str, config: Config) -> None:
    if config.mqtt is None:
        raise ConfigError("mqtt_topic: this key needs the section [mqtt], which names the broker")
    check_publish_topic("mqtt_topic", topic, config.mqtt, config)
