"""Access rules of our own broker, which mosquitto enforces.

Only the bridge publishes values, status and results. Its password is new at each start of the
broker, and only the UNIX socket accepts it.
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
"""Name of the bridge's account."""
MAX_LEVELS: Final = 64
"""Maximum number of levels of a register's path that can be written by MQTT."""
READERS: Final = MqttAccount(roles=["read"])
"""The account of clients that have no ``[[mqtt.account]]``."""


class Rights(NamedTuple):
    """What an account may do.

    ``filters``: the topics on which it may publish.
    """

    read: bool
    filters: Sequence[str]


def rights(settings: Mqtt, instance: str, accounts: Iterable[str] | None) -> dict[str | None, Rights]:
    """Return each account's rights by name; None: clients without an account.

    ``accounts``: names of the accounts that have a password; None: passwords are not used.
    """
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
    """Make the bridge's password, write it to its file, and return its hash for mosquitto."""
    secret = secrets.token_hex(32)
    write_private(place / SECRET, secret)
    return hashed(secret)


def secret_id(client_id: str, secret: str) -> str:
    """Return a client id that others cannot guess: who knows one can disconnect its client."""
    return f"{client_id}-{hashlib.sha256(f'{secret} {client_id}'.encode()).hexdigest()[:32]}"


ID: Final = re.compile(r"(?<=-)[0-9a-f]{32}\b")
"""Matches the secret part of such a client id."""
