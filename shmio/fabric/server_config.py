"""Makes the configuration of the NATS servers of a fabric: their users, and what each may do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import msgspec

from shmio.config.address import Address
from shmio.config.model import MqttTls
from shmio.fabric.messages import MAX_MESSAGE_BYTES
from shmio.fabric.names import CellName
from shmio.fabric.permissions import (
    EVERYTHING,
    FARM_USER,
    Permissions,
    cell_permissions,
    history_reader_permissions,
    viewer_permissions,
)

ROUTE_PORTS: Final = 2000
"""The servers of a cluster connect to each other at the port for clients plus this number."""
MAX_UNSENT_BYTES: Final = 64 << 20
"""Maximum size of what waits for a slow client. Beyond it, the server disconnects the client."""
ROUTE_USER: Final = "shmio"
CLUSTER: Final = "shmio"
FARM: Final = "shmio-farm"

Kind = Literal["admin", "cell", "viewer", "history-reader", "farm-user"]


FARM_LIMITS: Final = {"max_file": 2 << 30, "max_mem": 64 << 20, "max_streams": 2, "max_consumers": 1000}
"""Limits of what a farm may keep at a server; sizes are in bytes.

Its workers run other people's programs, and the cells need the disk, too. The streams are the queue and the bundles.
"""
ACCOUNTS: Final[dict[str, tuple[Kind, ...]]] = {
    "shmio-cells": ("admin", "cell", "viewer", "history-reader"),
    FARM: ("farm-user",),
}
"""The accounts, with the kinds of their users. Nothing of an account reaches the users of another one.

What a farm needs of JetStream would let its users publish in the name of cells. A server takes a folder
beside its own that has an account's name for its own, too, so none of the folders of seeds has.
"""


class User(NamedTuple):
    """A user of the servers. ``key`` is the public NKey."""

    kind: Kind
    name: str
    key: str


class ServerSettings(msgspec.Struct):
    """What all servers of a fabric share.

    Attributes:
        listen: Addresses for clients, one for each server. Several servers are a cluster.
        store: Directory in which a server keeps its streams.
        tls: PEM files of the servers; with ``ca``, clients need a certificate, too. None: without TLS.
        insecure: True if other hosts may connect without TLS.
        route_password: With it, the servers of a cluster accept each other.

    """

    listen: list[str]
    store: str
    tls: MqttTls | None = None
    insecure: bool = False
    route_password: str = ""


def server_configuration(settings: ServerSettings, index: int, users: Sequence[User]) -> str:
    """Return the configuration file of one server.

    Args:
        settings: What all servers share.
        index: Which of ``settings.listen`` the server is.
        users: Who may connect.

    """
    listen = Address.parse(settings.listen[index])
    name = f"shmio-{index + 1}"
    alone = len(settings.listen) == 1
    store = settings.store if alone else f"{settings.store}/{name}"
    sections: dict[str, Any] = {
        "host": listen.host,
        "port": listen.port,
        "server_name": name,
        "max_payload": MAX_MESSAGE_BYTES,
        "max_pending": MAX_UNSENT_BYTES,
        "jetstream": {"store_dir": store},
    }
    if settings.tls is not None:
        sections["tls"] = _tls(settings.tls)
    if not alone:
        sections["cluster"] = _cluster(settings, index)
    lines = [
        "# shmio fabric server-config wrote this file, and replaces it: run the command again instead of editing.",
        *(f"{key}: {_text(value)}" for key, value in sections.items()),
        "accounts: {",
    ]
    streams = tuple(CellName.parse(user.name).history for user in users if user.kind == "cell")
    for account, kinds in ACCOUNTS.items():
        stored = _text(FARM_LIMITS) if account == FARM else "enabled"
        lines += [f"  {account}: {{", f"    jetstream: {stored}", "    users: ["]
        for user in users:
            if user.kind in kinds:
                lines += [f"      # {user.kind} {user.name}".rstrip(), f"      {_text(_entry(user, streams))}"]
        lines += ["    ]", "  }"]
    return "\n".join([*lines, "}", ""])


def _entry(user: User, streams: tuple[str, ...]) -> dict[str, Any]:
    return {"nkey": user.key, "permissions": _permissions(user, streams).section()}


def _text(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def _permissions(user: User, streams: tuple[str, ...]) -> Permissions:
    if user.kind == "cell":
        cell = CellName.parse(user.name)
        return cell_permissions(cell, user.key, cell.history)
    if user.kind == "viewer":
        return viewer_permissions(user.key)
    if user.kind == "history-reader":
        return history_reader_permissions(user.key, streams)
    return FARM_USER if user.kind == "farm-user" else EVERYTHING


def _tls(tls: MqttTls) -> dict[str, Any]:
    files = {"cert_file": tls.certificate, "key_file": tls.key}
    return files if tls.ca is None else {**files, "ca_file": tls.ca, "verify": True}


def _cluster(settings: ServerSettings, index: int) -> dict[str, Any]:
    routes = [_route(address) for address in settings.listen]
    others = [
        f"nats-route://{ROUTE_USER}:{settings.route_password}@{route}"
        for number, route in enumerate(routes)
        if number != index
    ]
    found: dict[str, Any] = {
        "name": CLUSTER,
        "listen": str(routes[index]),
        "authorization": {"user": ROUTE_USER, "password": settings.route_password},
        "routes": others,
    }
    if settings.tls is not None:
        found["tls"] = _tls(settings.tls)
    return found


def _route(listen: str) -> Address:
    address = Address.parse(listen)
    return Address(address.host, address.port + ROUTE_PORTS)
