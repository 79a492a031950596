"""Reads credentials from files: bearer tokens, passwords, and HTTP headers of webhooks.

A file with credentials is refused if anyone but its owner has access to it. Messages never quote a
secret.
"""

from __future__ import annotations

import base64
import hashlib
import os
import re
import secrets
import stat
from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.config.model import MqttAccount, Token
from shmio.errors import ConfigError
from shmio.wording import larger_than

MIN_TOKEN_BYTES: Final = 20
MAX_TOKEN_BYTES: Final = 1024
MAX_PASSWORDS_BYTES: Final = 1 << 20
ROUNDS: Final = 101
"""Number of PBKDF2 rounds for hashes of passwords, the same as in mosquitto up to 2.0.

The broker checks a password once per connection.
"""
_KEY: Final = "mqtt.password_file"
_HASH: Final = re.compile(r"\$[0-9a-z-]{1,16}\$")
"""Matches the beginning of a password's hash of any kind."""
_HEADER: Final = re.compile(r"[A-Za-z0-9!#$%&'*+.^_`|~-]{1,100}")
_OWN_HEADERS: Final = ("connection", "content-length", "content-type", "host", "transfer-encoding")
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


class Secret(NamedTuple):
    """A bearer token's name, roles and SHA-256 digest; the token itself is not stored.

    The digest needs no salt, because tokens are random. It is made in only one round, because each
    check must be fast.
    """

    name: str
    roles: frozenset[str]
    digest: bytes


def read_tokens(tokens: Sequence[Token], section: str = "grpc.token") -> tuple[Secret, ...]:
    """Return name, roles and digest of each token in the configuration.

    Args:
        tokens: The sections of the tokens.
        section: The name of these sections, for messages.

    Raises:
        ConfigError: A token is invalid; the message names its key and never quotes the token.

    """
    found: dict[bytes, Secret] = {}
    for index, token in enumerate(tokens):
        key = f"{section}[{index}]"
        digest = bytes.fromhex(token.sha256) if token.sha256 is not None else read_token(key, str(token.token_file))
        if digest in found:
            raise ConfigError(
                f"{key}: this is the same token as that of {found[digest].name!r}; give each section its own token"
            )
        found[digest] = Secret(token.name, frozenset(token.roles), digest)
    return tuple(found.values())


def digest(token: bytes) -> bytes:
    """Return a token's SHA-256 digest."""
    return hashlib.sha256(token).digest()


def read_token(key: str, name: str) -> bytes:
    """Return the digest of the token in a file.

    Args:
        key: The section of the configuration that has the key ``token_file``, for messages.
        name: Path of the file.

    Raises:
        ConfigError: The file has no usable token, or other users have access to it; the message never quotes it.

    """
    key = f"{key}.token_file: {name}"
    text = read_secret(key, name, MAX_TOKEN_BYTES + 3, instead="a new token").rstrip(b"\r\n")
    if not MIN_TOKEN_BYTES <= len(text) <= MAX_TOKEN_BYTES or not all(0x21 <= byte <= 0x7E for byte in text):
        raise ConfigError(
            f"{key}: the file must contain one token of {MIN_TOKEN_BYTES} to {MAX_TOKEN_BYTES} letters, digits and "
            "signs, and nothing else; create one with openssl rand -hex 32"
        )
    return digest(text)


def read_password(name: str, key: str = _KEY) -> str:
    """Return shmio's password at an external broker or server: the first line of a file.

    Args:
        name: Path of the file.
        key: The configuration key that has this path, for messages.

    Raises:
        ConfigError: The file cannot be used, or its first line is empty; the message never quotes
            the password.

    """
    password = _read_passwords(name, key).split("\n", 1)[0].rstrip("\r")
    if not password:
        raise ConfigError(f"{key}: {name}: the first line is empty, but it must be the password")
    return password


def read_headers(name: str, key: str) -> dict[str, str]:
    """Return the HTTP headers in a file with lines ``Name: value``.

    Args:
        name: Path of the file.
        key: The configuration key that has this path, for messages.

    Raises:
        ConfigError: The file cannot be used; the message never quotes a value.

    """
    headers: dict[str, str] = {}
    for number, line in enumerate(_read_passwords(name, key).splitlines(), 1):
        if not line.strip():
            continue
        header, colon, value = line.partition(":")
        if not colon or not _HEADER.fullmatch(header) or not (value.strip().isascii() and value.strip().isprintable()):
            raise ConfigError(f"{key}: {name}: line {number}: expected a header such as Authorization: Bearer TOKEN")
        if header.lower() in _OWN_HEADERS:
            raise ConfigError(f"{key}: {name}: line {number}: shmio itself sets the header {header}; remove this line")
        headers[header] = value.strip()
    if not headers:
        raise ConfigError(f"{key}: {name}: the file has no header; expected lines such as Authorization: Bearer TOKEN")
    return headers


def read_accounts(name: str, roles: Sequence[MqttAccount] = ()) -> dict[str, str]:
    """Return the hashes of the passwords of all accounts of shmio's own broker, by account name.

    Args:
        name: Path of the file. Each line is ``name:password``, or ``name:hash`` as mosquitto_passwd
            writes it.
        roles: The accounts in the configuration, each of which must have a line in the file.

    Raises:
        ConfigError: The file cannot be used, or a line is invalid or missing. The message has the
            number of an invalid line, and never quotes a password.

    """
    accounts: dict[str, str] = {}
    for number, line in enumerate(_read_passwords(name).splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        user, colon, secret = line.partition(":")
        if not colon or not user.strip() or not secret:
            raise ConfigError(f"{_KEY}: {name}: line {number}: expected name:password")
        if user in accounts:
            raise ConfigError(f"{_KEY}: {name}: line {number}: this name is given twice; remove one of the lines")
        if user != user.strip() or secret != secret.strip():
            raise ConfigError(
                f"{_KEY}: {name}: line {number}: remove the blanks next to the colon and at both ends of the line, "
                "because they would belong to the name or the password"
            )
        known = _is_hash(secret)
        if not known and _HASH.match(secret):
            raise ConfigError(
                f"{_KEY}: {name}: line {number}: the hash is damaged, or of an unknown kind; make one with "
                "mosquitto_passwd -H sha512-pbkdf2, or write the password itself"
            )
        accounts[user] = secret if known else hashed(secret)
    if not accounts:
        raise ConfigError(f"{_KEY}: {name}: the file has no accounts; expected lines such as name:password")
    for index, account in enumerate(roles):
        if account.name is not None and account.name not in accounts:
            raise ConfigError(
                f"mqtt.account[{index}].name: {name} has no password for {account.name!r}; add a line "
                f"{account.name}:PASSWORD"
            )
    return accounts


def hashed(password: str) -> str:
    """Return a password's hash for mosquitto: PBKDF2 with SHA-512 (mosquitto-passwd(5))."""
    salt = secrets.token_bytes(12)
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, ROUNDS)
    return f"$7${ROUNDS}${base64.b64encode(salt).decode()}${base64.b64encode(digest).decode()}"


def _is_hash(secret: str) -> bool:
    """Return whether a text is a hash for mosquitto: ``$7$ROUNDS$SALT$DIGEST`` or ``$6$SALT$DIGEST``."""
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


def _read_passwords(name: str, key: str = _KEY) -> str:
    key = f"{key}: {name}"
    data = read_secret(key, name, MAX_PASSWORDS_BYTES + 1, instead="new passwords")
    if len(data) > MAX_PASSWORDS_BYTES:
        raise ConfigError(f"{key}: {larger_than(MAX_PASSWORDS_BYTES)}")
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{key}: the file is not UTF-8; save it as UTF-8") from None


def read_secret(key: str, name: str, most_bytes: int, *, instead: str) -> bytes:
    """Return the beginning of a file that contains a secret, at most ``most_bytes`` bytes.

    Args:
        key: The beginning of messages: the configuration key and the path.
        name: Path of the file.
        most_bytes: Maximum number of bytes to read.
        instead: Advice on how to replace a secret that others could have read, for the message.

    Raises:
        ConfigError: The file cannot be read, or other users have access to it; the message never
            quotes its contents.

    """
    try:
        fd = os.open(name, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # else a pipe without a writer blocks
    except OSError as error:
        raise ConfigError(f"{key}: {error.strerror}") from None
    try:
        mode = os.fstat(fd).st_mode
        if not stat.S_ISREG(mode):
            raise ConfigError(f"{key}: this is not a regular file")
        if mode & _OTHERS:
            raise ConfigError(
                f"{key}: other users may have read this file, because its mode is {stat.S_IMODE(mode):04o}; "
                f"run chmod 600, and use {instead}"
            )
        return os.read(fd, most_bytes)
    finally:
        os.close(fd)
