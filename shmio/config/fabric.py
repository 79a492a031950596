"""Checks the section ``[fabric]``, and makes its paths absolute."""

from __future__ import annotations

import importlib.util
from fnmatch import fnmatchcase
from typing import Final
from urllib.parse import urlsplit

from shmio.config.address import Address, check_host
from shmio.config.masking import mask_line
from shmio.config.model import Config, Fabric, FabricAllow
from shmio.errors import ConfigError
from shmio.wording import plain_text, unknown

PORT: Final = 4222
LISTEN: Final = f"127.0.0.1:{PORT}"
"""Address at which the embedded server listens if the configuration gives no other."""
STORE_MB: Final = 2000.0
"""Maximum size in MB of what the embedded server keeps on the disk beside the history of its own cell."""
SCHEMES: Final = ("nats", "tls")
ROLES: Final = ("read", "write", "inject")
"""Roles of the cells that send commands."""
EXTRA: Final = "fabric: the fabric needs another library; run pip install 'shmio[fabric]'"
_REMEDY: Final = "add a [fabric.tls] table, or write insecure = true in [fabric]"


def check_fabric(config: Config) -> None:
    """Check addresses, plain-text access, patterns and combinations of keys.

    Raises:
        ConfigError: A rule is broken.

    """
    fabric = config.fabric
    if fabric is None:
        return
    tls = fabric.tls
    if tls is not None and (tls.certificate is None) != (tls.key is None):
        raise ConfigError("fabric.tls: give both certificate and key, or neither")
    if fabric.embedded:
        _check_embedded(fabric)
    else:
        _check_external(fabric)
    if fabric.cell is None:
        for key in ("rule", "allow", "history"):
            if getattr(fabric, key) and not (key == "allow" and fabric.embedded):
                raise ConfigError(f"fabric.{key}: this section needs fabric.cell, the name under which to publish")
    for index, one in enumerate(fabric.allow):
        _check_allow(f"fabric.allow[{index}]", one)
    for index, rule in enumerate(fabric.rule):
        if rule.send == "nothing" and (rule.registers or rule.max_rate_hz is not None):
            raise ConfigError(
                f'fabric.rule[{index}]: registers and max_rate_hz have no effect with send = "nothing"; remove them'
            )


def _check_embedded(fabric: Fabric) -> None:
    """Check the keys for the server that the instance runs."""
    text = fabric.listen or LISTEN
    try:
        address = Address.parse(text)
    except ConfigError as error:
        raise ConfigError(f"fabric.listen: {error}") from None
    if not address.port:
        raise ConfigError(f"fabric.listen: {address} has no port; the usual one is {PORT}")
    tls = fabric.tls
    if tls is not None and tls.certificate is None:
        raise ConfigError("fabric.tls: the embedded server needs certificate and key")
    if not (address.loopback or tls or fabric.insecure):
        raise ConfigError(f"fabric.listen: {plain_text(text, _REMEDY)}")
    if fabric.store_mb is not None and fabric.history is not None and fabric.store_mb <= fabric.history.keep_mb:
        raise ConfigError(
            f"fabric.store_mb: {fabric.store_mb:g} MB have no room for the registry and the history of "
            f"{fabric.history.keep_mb:g} MB; raise it, or lower fabric.history.keep_mb"
        )
    if fabric.credentials is not None:
        raise ConfigError(
            "fabric.credentials: the embedded server knows the processes of its own instance; remove this key, or run "
            "a NATS server of your own"
        )


def _check_external(fabric: Fabric) -> None:
    """Check the keys for servers that others run."""
    for index, url in enumerate(fabric.servers):
        key = "fabric.server" if isinstance(fabric.server, str) else f"fabric.server[{index}]"
        address = server_address(key, url, "in fabric.credentials", ', or "embedded"')
        if not (address.loopback or fabric.tls or fabric.insecure or url.startswith("tls:")):
            raise ConfigError(f"{key}: shmio would send plain text over the network to {address}; {_REMEDY}")
    for key in ("listen", "store_mb"):
        if getattr(fabric, key) is not None:
            raise ConfigError(
                f'fabric.{key}: this key is only for server = "embedded", but server is {fabric.server!r}; remove it'
            )


def server_address(key: str, url: str, credentials: str, others: str = "") -> Address:
    """Return the address in the URL of a server.

    Args:
        key: Where the URL is, for messages.
        url: The URL.
        credentials: Where to name a file with credentials, for messages.
        others: What may take the place of a URL, for messages.

    Raises:
        ConfigError: It is not such a URL, or it has a password.

    """
    try:
        parts = urlsplit(url)
        port = parts.port or PORT
    except ValueError:
        parts, port = urlsplit(""), 0
    key, shown = mask_line(key), mask_line(url)
    if parts.scheme not in SCHEMES or not parts.hostname or parts.path.strip("/") or parts.query or parts.fragment:
        raise ConfigError(f"{key}: {shown!r} is not a NATS server; write nats://host:{PORT}, tls://host{others}")
    if parts.password or parts.username:
        raise ConfigError(f"{key}: a URL with a password is visible to others; name a file {credentials}")
    try:
        check_host(parts.hostname)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    return Address(parts.hostname, port)


def _check_allow(key: str, allow: FabricAllow) -> None:
    for pattern in allow.patterns:
        if pattern.count(".") != 2 or not all(pattern.split(".")):
            raise ConfigError(
                f"{key}.sender: {pattern!r} matches no cell; write plant.line.cell, such as plant1.*.*, where * stands "
                "for any characters of a part"
            )
    for index, role in enumerate(allow.roles):
        if role not in ROLES:
            raise ConfigError(f"{key}.roles[{index}]: {unknown('role', role, ROLES)}")


def matches_cell(pattern: str, cell: str) -> bool:
    """Return whether a pattern such as ``plant1.*.*`` matches the name of a cell, part by part."""
    patterns, parts = pattern.split("."), cell.split(".")
    return len(patterns) == len(parts) and all(map(fnmatchcase, parts, patterns))


def resolve_fabric(fabric: Fabric, config: Config) -> None:
    """Make the paths in the section absolute, and set the default address of the embedded server."""
    if fabric.embedded:
        fabric.listen = fabric.listen or LISTEN
        kept = 0.0 if fabric.history is None else fabric.history.keep_mb
        fabric.store_mb = fabric.store_mb or STORE_MB + kept
    fabric.directory = str(config.path(fabric.directory))
    if fabric.credentials is not None:
        fabric.credentials = str(config.path(fabric.credentials))
    if fabric.tls is not None:
        for field in ("ca", "certificate", "key"):
            if name := getattr(fabric.tls, field):
                setattr(fabric.tls, field, str(config.path(name)))


def check_library() -> None:
    """Check that the libraries for the fabric are installed.

    Raises:
        ConfigError: A library is not installed.

    """
    if importlib.util.find_spec("nats") is None:
        raise ConfigError(EXTRA)
