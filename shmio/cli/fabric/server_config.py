"""``shmio fabric server-config``: writes the configuration of the NATS servers, and the users' seeds."""

from __future__ import annotations

import argparse
import re
import secrets
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec

from shmio.cli.common import dumps
from shmio.config.address import Address
from shmio.config.fabric import LISTEN
from shmio.config.model import MqttTls
from shmio.config.tls import server_context
from shmio.errors import ConfigError
from shmio.fabric.connection import INSTALL, public_key
from shmio.fabric.names import CellName
from shmio.fabric.server_config import ROUTE_PORTS, Kind, ServerSettings, User, server_configuration
from shmio.files import create_file, replace_file
from shmio.libraries import library
from shmio.wording import plain_text, printable

SETTINGS: Final = "settings.json"
ADMIN: Final = "admin"
FOLDERS: Final[dict[str, Kind]] = {
    "cells": "cell",
    "viewers": "viewer",
    "history-readers": "history-reader",
    "farm-users": "farm-user",
}
"""Folders of the seeds, with the kind of their users."""
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}\Z")


def execute(options: argparse.Namespace) -> int:
    """Write the files. Existing seeds and earlier settings are kept."""
    folder: Path = options.directory
    new = _new_users(options)
    settings = _settings(options, folder)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    made = [file for file in new if _make_seed(folder / file)]
    users = list(_users(folder))
    replace_file(folder / SETTINGS, msgspec.json.format(msgspec.json.encode(settings)) + b"\n", private=True)
    written = []
    for index in range(len(settings.listen)):
        name = "nats-server.conf" if len(settings.listen) == 1 else f"nats-server-{index + 1}.conf"
        replace_file(folder / name, server_configuration(settings, index, users).encode(), private=True)
        written.append(folder / name)
    if options.json:
        seeds = [str(folder / file) for file in made]
        print(dumps({"configurations": [str(file) for file in written], "new_seeds": seeds, "users": len(users)}))
    else:
        _report(settings, folder, written, made, users)
    return 0


def _new_users(options: argparse.Namespace) -> list[Path]:
    """Return the paths of the seeds of the administrator and of the users that the options name."""
    found = [Path(f"{ADMIN}.seed")]
    for name in options.cells:
        try:
            found.append(Path("cells") / f"{CellName.parse(name)}.seed")
        except ConfigError as error:
            raise ConfigError(f"--cell: {error}") from None
    for option, folder, names in (
        ("--viewer", "viewers", options.viewers),
        ("--history-reader", "history-readers", options.readers),
        ("--farm-user", "farm-users", options.farm_users),
    ):
        for name in names:
            if not _NAME.match(name):
                raise ConfigError(
                    f"{option}: {name!r} is not a name; use at most 64 letters, digits, - and _, and begin with a "
                    "letter or digit"
                )
            found.append(Path(folder) / f"{name}.seed")
    return found


def _settings(options: argparse.Namespace, folder: Path) -> ServerSettings:
    """Return the settings of an earlier run, changed by the options.

    Raises:
        ConfigError: The options do not fit together, or a file cannot be used.

    """
    file = folder / SETTINGS
    try:
        settings = msgspec.json.decode(file.read_bytes(), type=ServerSettings)
    except FileNotFoundError:
        settings = ServerSettings([LISTEN], str(folder.resolve()))  # nats-server adds the folder jetstream
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{file}: the file is damaged ({error}); remove it, and give all options again") from None
    if options.listen:
        settings.listen = options.listen
    if options.store is not None:
        settings.store = str(options.store.resolve())
    if options.certificate or options.key or options.ca:
        paths = [name and str(Path(name).resolve()) for name in (options.ca, options.certificate, options.key)]
        settings.tls = MqttTls(*paths)
    settings.insecure = settings.insecure or options.insecure
    if len(settings.listen) > 1:
        settings.route_password = settings.route_password or secrets.token_urlsafe(32)
    if settings.tls is not None:
        if settings.tls.certificate is None or settings.tls.key is None:
            raise ConfigError("--certificate: TLS needs both --certificate and --key")
        server_context(settings.tls, "--")
    for text in settings.listen:
        _check_listen(text, settings)
    if len(set(settings.listen)) < len(settings.listen):
        raise ConfigError("--listen: two servers have the same address; give each server its own")
    return settings


def _check_listen(text: str, settings: ServerSettings) -> None:
    try:
        address = Address.parse(text)
    except ConfigError as error:
        raise ConfigError(f"--listen: {error}") from None
    if not 0 < address.port <= 65535 - ROUTE_PORTS:
        raise ConfigError(f"--listen: {text}: choose a port from 1 to {65535 - ROUTE_PORTS}, such as 4222")
    if len(settings.listen) > 1 and address.wildcard:
        raise ConfigError(f"--listen: {text}: the other servers of the cluster need this server's name or address")
    if not (address.loopback or settings.tls or settings.insecure):
        raise ConfigError(f"--listen: {plain_text(text, 'give --certificate and --key, or --insecure')}")


def _make_seed(file: Path) -> bool:
    """Make the seed of a new user, and return whether the file is new."""
    nkeys = library("nkeys", INSTALL)
    file.parent.mkdir(mode=0o700, exist_ok=True)
    try:
        create_file(file, nkeys.encode_seed(secrets.token_bytes(32), nkeys.PREFIX_BYTE_USER) + b"\n", private=True)
    except FileExistsError:
        return False
    return True


def _users(folder: Path) -> Iterator[User]:
    """Yield the users whose seeds are in the folder."""
    yield User("admin", "", _key(folder / f"{ADMIN}.seed"))
    for name, kind in FOLDERS.items():
        for file in sorted((folder / name).glob("*.seed")):
            if kind == "cell":
                CellName.parse(file.stem)
            elif not _NAME.match(file.stem):
                raise ConfigError(f"{file}: the name of the file is not the name of a user; rename or remove the file")
            yield User(kind, file.stem, _key(file))


def _key(file: Path) -> str:
    if file.stat().st_mode & 0o077:
        raise ConfigError(f"{file}: other users can read or change this seed; run chmod 600 {file}, or remove the file")
    return public_key(file.read_text(encoding="ascii", errors="replace").strip(), file)


def _tls_options(tls: MqttTls | None) -> str:
    """Return the options by which a client reaches the servers, with a space at the end."""
    if tls is None:
        return ""
    own = "" if tls.ca is None else "--certificate CLIENT.pem --key CLIENT.key "
    return f"--ca {tls.certificate} {own}"


def _report(
    settings: ServerSettings, folder: Path, written: Sequence[Path], made: Sequence[Path], users: Sequence[User]
) -> None:
    lines = [f"wrote {file}" for file in written]
    lines += [f"wrote {folder / file}" for file in made]
    lines.append(f"{len(users)} users: {', '.join(user.name or user.kind for user in users)}")
    scheme = "nats" if settings.tls is None else "tls"
    replicas = f" --replicas {min(3, len(settings.listen))}" if len(settings.listen) > 1 else ""
    address = Address.parse(settings.listen[0])
    here = str(address.here)
    if address.wildcard and settings.tls is not None:
        here = f"NAME-IN-THE-CERTIFICATE:{address.port}"
    prepare = f"shmio fabric prepare --server {scheme}://{here} {_tls_options(settings.tls)}"
    prepare += f"--credentials {folder / ADMIN}.seed{replicas}"
    farm = any(user.kind == "farm-user" for user in users)
    cells = not farm or any(user.kind not in ("admin", "farm-user") for user in users)
    start = f"next: start {' and '.join(f'nats-server -c {file}' for file in written)}"
    lines.append(f"{start}, then run {prepare} once" if cells else start)
    if cells:
        lines.append("copy each seed to its host: a cell names it in fabric.credentials, a command in --credentials")
    if farm:
        lines.append(
            "copy the seeds of farm users to the hosts of the farm, and name them in --credentials of "
            f"shmio-campaign worker --farm {scheme}://{here} and of shmio-campaign falsify"
        )
    lines += [
        "nats-server --signal reload=PID makes a running server read the file again",
    ]
    print("\n".join(map(printable, lines)))
