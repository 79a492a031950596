"""Read the gRPC endpoint's bearer tokens, of which only hashes are kept."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.config.model import Token
from shmio.config.secret_file import read_secret
from shmio.errors import ConfigError

MIN_LENGTH: Final = 20
MAX_LENGTH: Final = 1024


class Secret(NamedTuple):
    """A token's name, roles and SHA-256 digest.

    A random text needs no salt, and each check must be cheap.
    """

    name: str
    roles: frozenset[str]
    digest: bytes


def read_tokens(tokens: Sequence[Token]) -> tuple[Secret, ...]:
    """Read all tokens; ConfigError names the key of an invalid token and never quotes it."""
    found: dict[bytes, Secret] = {}
    for index, token in enumerate(tokens):
        key = f"grpc.token[{index}]"
        digest = bytes.fromhex(token.sha256) if token.sha256 is not None else _read(key, str(token.token_file))
        if digest in found:
            raise ConfigError(f"{key}: the same token as that of {found[digest].name!r}; give each one of its own")
        found[digest] = Secret(token.name, frozenset(token.roles), digest)
    return tuple(found.values())


def digest(token: bytes) -> bytes:
    """Return a token's SHA-256 digest."""
    return hashlib.sha256(token).digest()


def _read(key: str, name: str) -> bytes:
    key = f"{key}.token_file: {name}"
    text = read_secret(key, name, MAX_LENGTH + 3, instead="a new token").rstrip(b"\r\n")
    if not MIN_LENGTH <= len(text) <= MAX_LENGTH or not all(0x21 <= byte <= 0x7E for byte in text):
        raise ConfigError(
            f"{key}: expected one token of {MIN_LENGTH} to {MAX_LENGTH} letters, digits and signs, and nothing else: "
            f"openssl rand -hex 32 makes one"
        )
    return digest(text)
