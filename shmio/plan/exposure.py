"""Find what other users of this host may do to an instance through its loopback ports."""

from __future__ import annotations

import os
import pwd
from collections.abc import Iterable, Iterator
from typing import Final

from shmio.config import Config, UnixAddress, parse_address
from shmio.config.listening import encrypted
from shmio.endpoints.mqtt.broker.program import find_mosquitto

FIRST_UID: Final = 1000
NOBODY: Final = 65534
NO_SHELLS: Final = ("nologin", "false", "sync")
MAX_NAMES: Final = 3


def exposure(config: Config) -> str | None:
    """Return a line on what other users of this host may do without authentication, or None."""
    ways = [*_grpc(config), *_mqtt(config)]
    users = other_users() if ways else []
    if not users:
        return None
    more = len(users) - MAX_NAMES
    names = ", ".join(users[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
    return (
        f"note: other users of this host ({names}) may {'; and '.join(ways)} without logging in: "
        "a UNIX socket, tokens or accounts prevent that, see SECURITY.md"
    )


def other_users() -> list[str]:
    """Return the names of other users who can log in, without root.

    A directory service need not list all its users.
    """
    return [user.pw_name for user in pwd.getpwall() if _may_log_in(user) and user.pw_uid not in (0, os.geteuid())]


def _may_log_in(user: pwd.struct_passwd) -> bool:
    return FIRST_UID <= user.pw_uid != NOBODY and os.path.basename(user.pw_shell) not in NO_SHELLS  # noqa: PTH119


def _grpc(config: Config) -> Iterator[str]:
    """Yield what clients without token and certificate may do by gRPC."""
    grpc = config.grpc
    if grpc is None:
        return
    by_roles: dict[tuple[str, ...], list[str]] = {}
    for address in grpc.listening.values():
        asked = grpc.tls is not None and grpc.tls.client_ca is not None and encrypted(grpc, address)
        roles = tuple(role for role in address.roles if role != "read")
        if roles and not asked and not isinstance(parse_address(address.listen), UnixAddress):
            by_roles.setdefault(roles, []).append(address.listen)
    for roles, addresses in by_roles.items():
        yield f"{_joined(roles)} by gRPC at {_joined(addresses)}"


def _mqtt(config: Config) -> Iterator[str]:
    """Yield what clients without account may do at shmio's own broker."""
    mqtt = config.mqtt
    if mqtt is None or not mqtt.listen:
        return
    if find_mosquitto() is None:
        yield f"publish everything, values too, by MQTT at {mqtt.listen}, where aMQTT asks for no account"
        return
    free = any(account.name is None and "write" in account.roles for account in mqtt.account)
    if free and not (mqtt.tls and mqtt.tls.ca) and any(source.writable for source in config.source):
        yield f"write by MQTT at {mqtt.listen}"


def _joined(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
