"""Checks the section ``[opcua]``, and makes its paths absolute."""

from __future__ import annotations

import importlib.util
from typing import Final

from shmio.config.address import Address
from shmio.config.model import ROLES, Config, OpcUa
from shmio.errors import ConfigError
from shmio.wording import PLAIN_REMEDY, already_named, plain_text, unknown

EXTRA: Final = "opcua: the OPC UA endpoint needs another library; run pip install 'shmio[opcua]'"


def check_opcua(config: Config) -> None:
    """Check the address, plain-text access and combinations of keys in ``[opcua]``.

    Raises:
        ConfigError: A key breaks a rule, or contradicts another key.

    """
    opcua = config.opcua
    if opcua is None:
        return
    if (opcua.certificate is None) != (opcua.key is None):
        raise ConfigError("opcua.certificate: give both certificate and key, or neither")
    try:
        address = Address.parse(opcua.listen)
    except ConfigError as error:
        raise ConfigError(f"opcua.listen: {error}") from None
    if not address.loopback and opcua.certificate is None and not opcua.insecure:
        raise ConfigError(f"opcua.listen: {plain_text(opcua.listen, PLAIN_REMEDY)}")
    if opcua.trusted and opcua.certificate is None:
        raise ConfigError(
            "opcua.trusted: clients show certificates only to a server that has one; give certificate and key"
        )
    if opcua.trusted and opcua.insecure:
        raise ConfigError(
            "opcua.trusted: this key has no effect with insecure = true, which admits clients without "
            "certificate; remove one of the two"
        )
    if opcua.client and not opcua.trusted:
        raise ConfigError(
            "opcua.client: this section identifies clients by their certificates, so it needs trusted in [opcua]"
        )
    if opcua.account and opcua.certificate is None and not address.loopback:
        raise ConfigError(
            "opcua.account: other hosts would send passwords without encryption; give certificate and key in [opcua]"
        )
    _check_roles(opcua)


def _check_roles(opcua: OpcUa) -> None:
    given = {"opcua.anonymous": opcua.anonymous or []}
    given |= {f"opcua.account[{index}].roles": account.roles for index, account in enumerate(opcua.account)}
    given |= {f"opcua.client[{index}].roles": client.roles for index, client in enumerate(opcua.client)}
    for key, roles in given.items():
        for index, role in enumerate(roles):
            if role not in ROLES:
                raise ConfigError(f"{key}[{index}]: {unknown('role', role, ROLES)}")
    names: dict[str, int] = {}
    for index, account in enumerate(opcua.account):
        key = f"opcua.account[{index}]"
        if account.name in names:
            raise ConfigError(f"{key}.name: {already_named(account.name, f'opcua.account[{names[account.name]}]')}")
        names[account.name] = index
        if (account.token_file is None) == (account.sha256 is None):
            raise ConfigError(f"{key}: give either token_file, a file with only the password, or sha256, its hash")
        if account.sha256 is not None and (len(account.sha256) != 64 or set(account.sha256) - set("0123456789abcdef")):
            raise ConfigError(
                f"{key}.sha256: expected 64 hexadecimal digits, as this command prints: printf %s PASSWORD | sha256sum"
            )


def resolve_opcua(opcua: OpcUa, config: Config) -> None:
    """Make the paths in ``[opcua]`` absolute."""
    for field in ("certificate", "key"):
        if name := getattr(opcua, field):
            setattr(opcua, field, str(config.path(name)))
    opcua.trusted = [str(config.path(name)) for name in opcua.trusted]
    for account in opcua.account:
        if account.token_file is not None:
            account.token_file = str(config.path(account.token_file))


def check_library() -> None:
    """Check that the library for OPC UA is installed.

    Raises:
        ConfigError: The library is not installed.

    """
    if importlib.util.find_spec("asyncua") is None:
        raise ConfigError(EXTRA)
