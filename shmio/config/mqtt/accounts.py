"""MQTT passwords: shmio's at an external broker, and those of its own broker's clients."""

from __future__ import annotations

import base64
import hashlib
import re
import secrets
from collections.abc import Sequence
from typing import Final

from shmio.config.model import MqttAccount
from shmio.config.secret_file import read_secret
from shmio.errors import ConfigError

MAX_BYTES: Final = 1 << 20
ROUNDS: Final = 101
"""PBKDF2 rounds, as mosquitto up to 2.0 uses; a password is checked once per connection."""
KEY: Final = "mqtt.password_file"
_HASH: Final = re.compile(r"\$[0-9a-z-]{1,16}\$")
"""Matches the beginning of a hash of any kind."""


def read_password(name: str) -> str:
    """Return the password for an external broker: the file's first line.

    Raises:
        ConfigError: The file is unusable or its first line is empty; never quotes its contents.

    """
    password = _read(name).split("\n", 1)[0].rstrip("\r")
    if not password:
        raise ConfigError(f"{KEY}: {name}: its first line, the password, is empty")
    return password


def read_accounts(name: str, roles: Sequence[MqttAccount] = ()) -> dict[str, str]:
    """Return the password hashes of the accounts of shmio's own broker, by account name.

    Args:
        name: Path of the file. Each line is ``name:password``, or ``name:hash`` as
            mosquitto_passwd writes it.
        roles: Accounts that must have a line.

    Raises:
        ConfigError: A line is invalid or missing; names the line and never quotes it.

    """
    accounts: dict[str, str] = {}
    for number, line in enumerate(_read(name).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        user, colon, secret = line.partition(":")
        if not colon or not user.strip() or not secret:
            raise ConfigError(f"{KEY}: {name}: line {number}: expected name:password")
        if user in accounts:
            raise ConfigError(f"{KEY}: {name}: line {number}: this name is given twice")
        if user != user.strip() or secret != secret.strip():
            raise ConfigError(
                f"{KEY}: {name}: line {number}: a blank next to the colon, or at an end, would be a part of it"
            )
        known = _is_hash(secret)
        if not known and _HASH.match(secret):
            raise ConfigError(
                f"{KEY}: {name}: line {number}: an unknown or damaged hash: use "
                "mosquitto_passwd -H sha512-pbkdf2, or write the password itself"
            )
        accounts[user] = secret if known else hashed(secret)
    if not accounts:
        raise ConfigError(f"{KEY}: {name}: it has no accounts; expected lines name:password")
    for index, account in enumerate(roles):
        if account.name is not None and account.name not in accounts:
            raise ConfigError(f"mqtt.account[{index}].name: {account.name!r} has no line in {name}")
    return accounts


def hashed(password: str) -> str:
    """Return a password's hash for mosquitto: PBKDF2 with SHA-512 (mosquitto-passwd(5))."""
    salt = secrets.token_bytes(12)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, ROUNDS)
    return f"$7${ROUNDS}${base64.b64encode(salt).decode()}${base64.b64encode(digest).decode()}"


def _is_hash(secret: str) -> bool:
    """Return whether mosquitto knows a hash: ``$7$ROUNDS$SALT$DIGEST`` or ``$6$SALT$DIGEST``."""
    fields = secret.split("$")
    try:
        pbkdf2 = fields[:2] == ["", "7"] and len(fields) == 5 and 0 < int(fields[2]) <= 10_000_000
        if not pbkdf2 and not (fields[:2] == ["", "6"] and len(fields) == 4):
            return False
        for part in fields[-2:]:
            base64.b64decode(part, validate=True)
    except ValueError:
        return False
    return True


def _read(name: str) -> str:
    key = f"{KEY}: {name}"
    data = read_secret(key, name, MAX_BYTES + 1, instead="new passwords")
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{key}: larger than {MAX_BYTES} bytes")
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{key}: not UTF-8") from None
