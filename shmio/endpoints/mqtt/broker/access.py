"""What the clients of our own broker may do: the rules that mosquitto enforces.

Nobody but the bridge publishes values, status and results: its account is made anew at each start of the broker, and is
let in by the UNIX socket alone.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from shmio.config import Mqtt, MqttAccount
from shmio.config.mqtt.accounts import hashed
from shmio.endpoints.mqtt.broker.directory import SECRET, write_private

BRIDGE: Final = "bridge"
"""The bridge's account."""
MAX_LEVELS: Final = 64
"""Of a register's path that is written by MQTT."""
READERS: Final = MqttAccount(roles=["read"])
"""Who has no ``[[mqtt.account]]``."""


class Rights(NamedTuple):
    """``filters``: of the topics that may be published on."""

    read: bool
    filters: Sequence[str]


def rights(settings: Mqtt, instance: str, accounts: Iterable[str] | None) -> dict[str | None, Rights]:
    """Of each account, by its name; None: of who shows none. ``accounts``: names of those with a password, if asked."""
    given = {account.name: account for account in settings.account}
    for name in [None] if accounts is None else accounts:
        given.setdefault(name, READERS)
    commands = list(_commands(settings, instance))
    return {
        name: Rights("read" in account.roles, [*account.publish, *commands] if "write" in account.roles else [])
        for name, account in given.items()
    }


def _commands(settings: Mqtt, instance: str) -> Iterator[str]:
    prefix = settings.prefix or f"shmio/{instance}"
    for levels in range(1, MAX_LEVELS + 1):
        yield f"{prefix}/+/{'+/' * levels}in"
    if node := settings.sparkplug:
        name = node.node or instance
        yield from (f"spBv1.0/{node.group}/NCMD/{name}", f"spBv1.0/{node.group}/DCMD/{name}/+", "spBv1.0/STATE/+")


def new_secret(place: Path) -> str:
    """Make the bridge's password, which it finds there; its hash, as mosquitto knows it."""
    secret = secrets.token_hex(32)
    write_private(place / SECRET, secret)
    return hashed(secret)


def secret_id(client_id: str, secret: str) -> str:
    """The client id of one of the bridge's connections: who knew it could push it out, as MQTT has it."""
    return f"{client_id}-{hashlib.sha256(f'{secret} {client_id}'.encode()).hexdigest()[:32]}"


ID: Final = re.compile(r"(?<=-)[0-9a-f]{32}\b")
"""What is secret of such an id."""
