"""Checks addresses to listen on, tokens and roles; makes the paths in ``[grpc]`` absolute."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Final

from shmio.config.address import UNIX, Address, UnixAddress, parse_address
from shmio.config.model import ROLES, Config, Grpc, Listening, Token
from shmio.errors import ConfigError
from shmio.wording import already_named, plain_text, unknown

Place = Address | UnixAddress

_DIGITS: Final = frozenset("0123456789abcdef")


def check_listening(config: Config, catching: Callable[[], AbstractContextManager[None]]) -> None:
    """Check addresses to listen on, plain-text access, tokens and roles.

    ``catching`` returns a context manager that collects a ConfigError instead of raising it.
    """
    for index, emulator in enumerate(config.emulator):
        key, remedy = f"emulator[{index}].listen", "write insecure = true in the same section"
        with catching():
            _check_address(key, emulator.listen, Address.parse, safe=emulator.insecure, remedy=remedy)
    if config.grpc:
        with catching():
            _check_tokens(config.grpc)
        with catching():
            _check_addresses(config.grpc)


def resolve(grpc: Grpc, config: Config) -> None:
    """Make the paths in ``[grpc]`` absolute."""
    for token in grpc.token:
        if token.token_file is not None:
            token.token_file = str(config.path(token.token_file))
    if grpc.tls:
        for field in ("certificate", "key", "client_ca"):
            if name := getattr(grpc.tls, field):
                setattr(grpc.tls, field, str(config.path(name)))
    grpc.listen = [_resolved(f"grpc.listen[{index}]", text, config) for index, text in enumerate(grpc.listen)]
    for index, address in enumerate(grpc.address):
        address.listen = _resolved(f"grpc.address[{index}].listen", address.listen, config)


def encrypted(grpc: Grpc, address: Listening) -> bool:
    """Return whether an address uses TLS.

    A UNIX socket never uses TLS, because only this host can reach it.
    """
    return grpc.tls is not None and not address.insecure and not address.listen.startswith(UNIX)


def takes_tokens(grpc: Grpc, address: Listening) -> bool:
    """Return whether the endpoint accepts tokens at an address.

    It accepts them if nobody can read them on the network, or if the configuration allows tokens in
    plain text.
    """
    return encrypted(grpc, address) or parse_address(address.listen).loopback or address.tokens_in_plain_text


def _resolved(key: str, text: str, config: Config) -> str:
    if not text.startswith(UNIX):
        return text
    try:
        return str(UnixAddress.parse(f"{UNIX}{config.path(UnixAddress.parse(text).path)}"))
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None


def _check_addresses(grpc: Grpc) -> None:
    if not grpc.listening:
        raise ConfigError("grpc.listen: this key is needed")
    for key, address in grpc.listening.items():
        remedy = "add a [grpc.tls] table, or write insecure = true in the same section"
        _check_address(key, address.listen, parse_address, safe=address.insecure or grpc.tls is not None, remedy=remedy)
        if not address.roles and grpc.token and not takes_tokens(grpc, address):
            raise ConfigError(
                f"{key}: {address.listen} is plain text, so other hosts could read the tokens of [[grpc.token]]; "
                "add a [grpc.tls] table; or write a [[grpc.address]] for it, with roles for clients without a token; "
                "or accept the risk with tokens_in_plain_text = true in the same section"
            )
        if not address.roles and not grpc.token and not encrypted(grpc, address):
            raise ConfigError(
                f"{key}: {address.listen} uses no certificates, so it cannot recognise a [[grpc.client]]; write a "
                "[[grpc.address]] for it, with roles for all who reach it, or add a [[grpc.token]]"
            )
    for index, address in enumerate(grpc.address):
        _check_roles(f"grpc.address[{index}]", address.roles)


def _check_address(key: str, text: str, parse: Callable[[str], Place], *, safe: bool, remedy: str) -> None:
    try:
        address = parse(text)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    if not address.loopback and not safe:
        raise ConfigError(f"{key}: {plain_text(text, remedy)}")


def _check_tokens(grpc: Grpc) -> None:
    names: dict[str, str] = {}
    for index, token in enumerate(grpc.token):
        key = f"grpc.token[{index}]"
        if token.name in names:
            raise ConfigError(f"{key}.name: {already_named(token.name, names[token.name])}")
        names[token.name] = key
        _check_roles(key, token.roles)
        _check_secret(key, token)
    for index, client in enumerate(grpc.client):
        _check_roles(f"grpc.client[{index}]", client.roles)
    if grpc.client and (grpc.tls is None or grpc.tls.client_ca is None):
        raise ConfigError(
            "grpc.client: this section identifies clients by their certificates, so it needs client_ca in [grpc.tls]"
        )


def _check_roles(key: str, roles: Sequence[str]) -> None:
    for index, role in enumerate(roles):
        if role not in ROLES:
            raise ConfigError(f"{key}.roles[{index}]: {unknown('role', role, ROLES)}")


def _check_secret(key: str, token: Token) -> None:
    if (token.token_file is None) == (token.sha256 is None):
        raise ConfigError(f"{key}: give either token_file, a file with only the token, or sha256, the token's hash")
    if token.sha256 is not None and (len(token.sha256) != 64 or not _DIGITS.issuperset(token.sha256)):
        raise ConfigError(
            f"{key}.sha256: expected 64 hexadecimal digits, as this command prints: printf %s TOKEN | sha256sum"
        )
