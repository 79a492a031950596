"""Checks what a configuration needs from the host, and finds what it allows other users of the host to do."""

from __future__ import annotations

import grp
import os
import pwd
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from shmio import realtime
from shmio.config import Alert, Config, Metrics, Mqtt, OpcUa, UnixAddress, parse_address
from shmio.config.credentials import read_accounts, read_headers, read_password, read_token, read_tokens
from shmio.config.fabric import check_library as check_fabric_library
from shmio.config.folder import unwritable
from shmio.config.listening import encrypted
from shmio.config.model import ROLES, Fabric, MqttTls
from shmio.config.opcua import check_library as check_opcua_library
from shmio.config.tls import client_context, read_tls, server_context
from shmio.config.web import check_library as check_web_library
from shmio.config.web import http_sections
from shmio.endpoints.fabric.server import check_installed
from shmio.endpoints.mqtt.broker.program import choose_broker, find_mosquitto
from shmio.errors import ConfigError
from shmio.fabric.connection import Access, read_credentials
from shmio.fabric.names import CellName

FIRST_UID: Final = 1000
NOBODY: Final = 65534
NO_SHELLS: Final = ("nologin", "false", "sync")
MAX_NAMES: Final = 3


def check_host(
    config: Config, catching: Callable[[], AbstractContextManager[None]], *, writes_files: bool = True
) -> list[str]:
    """Check group, priorities, folders, libraries and other files, without creating any; return warnings.

    ``catching`` returns a context manager that collects a ConfigError instead of raising it. Without
    ``writes_files``, the folders of the logs and the recordings are not checked.
    """
    with catching():
        _check_group(config.instance.group)
    for index, source in enumerate(config.source):
        with catching():
            _check_priority(f"source[{index}]", source.realtime_priority)
    for index, emulator in enumerate(config.emulator):
        with catching():
            _check_priority(f"emulator[{index}]", emulator.realtime_priority)
    warnings: list[str] = []
    if writes_files:
        with catching():
            warnings += _check_folder("instance.log_dir", config.log_dir)
    if writes_files and config.recorder:
        with catching():
            warnings += _check_folder("recorder.directory", config.path(config.recorder.directory))
    if config.grpc:
        with catching():
            if config.grpc.tls:
                read_tls(config.grpc.tls)
        with catching():
            read_tokens(config.grpc.token)
    if config.mqtt:
        with catching():
            _check_mqtt(config.mqtt)
    if config.opcua:
        with catching():
            warnings += _check_opcua(config.opcua)
    if config.fabric:
        with catching():
            _check_fabric(config.fabric)
    for key, section in http_sections(config):
        with catching():
            _check_http(key, section)
    for index, alert in enumerate(config.alert):
        with catching():
            _check_alert(f"alert[{index}]", alert)
    return warnings


def _check_mqtt(mqtt: Mqtt) -> None:
    """Check the files that the MQTT processes read, and the broker that they start."""
    external = mqtt.broker == "external"
    if mqtt.tls:
        (client_context if external else server_context)(mqtt.tls)
    if mqtt.password_file:
        if external:
            read_password(mqtt.password_file)
        else:
            read_accounts(mqtt.password_file, mqtt.account)
    if not external:
        choose_broker(mqtt)


def _check_opcua(opcua: OpcUa) -> Iterator[str]:
    """Check the library and the files of the OPC UA endpoint; yield warnings."""
    check_opcua_library()
    from shmio.endpoints.opcua.certificates import (  # noqa: PLC0415  it needs the extra
        application_uri,
        read_certificates,
        read_identity,
    )

    read_tokens(opcua.account, "opcua.account")
    for name in opcua.trusted:
        read_certificates("opcua.trusted", Path(name))
    identity = read_identity(opcua)
    if identity is not None and application_uri(identity[0]) is None:
        yield (
            f"opcua.certificate: {opcua.certificate}: this certificate has no application URI (a URI among its "
            "subject alternative names); many clients refuse such a certificate"
        )


def _check_fabric(fabric: Fabric) -> None:
    """Check the libraries, the embedded server, the cell's name, and the files."""
    check_fabric_library()
    if fabric.embedded:
        check_installed()
        if reason := unwritable(Path(fabric.directory)):
            raise ConfigError(f"fabric.directory: {reason.reason}")
    if fabric.cell is not None:
        try:
            CellName.parse(fabric.cell)
        except ConfigError as error:
            raise ConfigError(f"fabric.cell: {error}") from None
    if fabric.tls is not None:
        (server_context if fabric.embedded else client_context)(fabric.tls, "fabric.tls.")
    read_credentials(Access.of(fabric))


def _check_http(key: str, section: Metrics) -> None:
    """Check the libraries and the files of the HTTP endpoint."""
    check_web_library(key)
    if section.token_file is not None:
        read_token(key, section.token_file)
    if section.certificate and section.key:
        server_context(MqttTls(certificate=section.certificate, key=section.key), f"{key}.")


def _check_alert(key: str, alert: Alert) -> None:
    """Check that the program of an alert exists, and that the files of its webhook can be used."""
    if alert.command is not None:
        program = alert.command[0]
        if shutil.which(program) is None:
            there = Path(program).is_file()
            raise ConfigError(
                f"{key}.command: {program}: "
                + (
                    "this file is not executable; run chmod +x"
                    if there
                    else "there is no such program; give its full path"
                )
                + ". The list holds the program and its arguments; no shell reads it"
            )
    if alert.webhook_header_file is not None:
        read_headers(alert.webhook_header_file, f"{key}.webhook_header_file")
    if alert.webhook_ca is not None:
        client_context(MqttTls(ca=alert.webhook_ca), f"{key}.webhook_")


def _check_group(name: str | None) -> None:
    if name is None:
        return
    try:
        gid = grp.getgrnam(name).gr_gid
    except KeyError:
        raise ConfigError(f"instance.group: this host has no group {name!r}") from None
    if os.geteuid() != 0 and gid not in (os.getegid(), *os.getgroups()):
        raise ConfigError(
            f"instance.group: this user is not in group {name!r}, and so cannot give that group access to the segment"
        )


def _check_priority(key: str, priority: int | None) -> None:
    try:
        if priority is not None:
            realtime.check(priority)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None


def _check_folder(key: str, folder: Path) -> list[str]:
    """Check that a folder can be written; if its disk is full, return a warning.

    Raises:
        ConfigError: The folder cannot be written for another reason.

    """
    found = unwritable(folder)
    if found is None:
        return []
    if found.full:
        return [f"{key}: {found.reason}"]
    raise ConfigError(f"{key}: {found.reason}")


def exposure(config: Config) -> str | None:
    """Return a line that says what other users of this host may do without credentials; None if nothing."""
    ways = [
        *_open_grpc(config),
        *_open_mqtt(config),
        *_open_opcua(config),
        *_open_web(config),
    ]
    by_nats = list(_open_fabric(config))
    users = other_users() if ways or by_nats else []
    if not users:
        return None
    more = len(users) - MAX_NAMES
    names = ", ".join(users[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
    remedies = ["a UNIX socket, tokens or accounts prevent this (see SECURITY.md)"] if ways else []
    if by_nats:
        remedies.append("for NATS, fabric.tls.ca or a server of shmio fabric server-config prevents this")
    return (
        f"note: other users of this host ({names}) may {'; and '.join(ways + by_nats)} without logging in: "
        f"{'; '.join(remedies)}"
    )


def open_doors(config: Config) -> Iterator[str]:
    """Yield a line for each listener that serves clients without credentials although the configuration has some."""
    grpc, mqtt, opcua = config.grpc, config.mqtt, config.opcua
    guards = {
        "[[grpc.token]]": grpc is not None and grpc.token,
        "[[grpc.client]]": grpc is not None and grpc.client,
        "token_file": any(section.token_file is not None for _, section in http_sections(config)),
        "mqtt.password_file": mqtt is not None and mqtt.password_file is not None,
        "[[opcua.account]]": opcua is not None and opcua.account,
        "[[opcua.client]]": opcua is not None and opcua.client,
        "opcua.trusted": opcua is not None and opcua.trusted,
    }
    given = [name for name, there in guards.items() if there]
    for key, listen, what in _doors(config) if given else ():
        yield f"note: {key}: clients without credentials may {what} at {listen}, although there is {_joined(given)}"


def _doors(config: Config) -> Iterator[tuple[str, str, str]]:
    """Yield (key, address, what clients without credentials may do) of each listener that other users can reach."""
    grpc, mqtt, opcua, fabric = config.grpc, config.mqtt, config.opcua, config.fabric
    for key, address in grpc.listening.items() if grpc else ():
        asked = grpc is not None and grpc.tls is not None and grpc.tls.client_ca and encrypted(grpc, address)
        if address.roles and not asked and not isinstance(parse_address(address.listen), UnixAddress):
            yield key, address.listen, _joined(address.roles)
    for name, section in http_sections(config):
        if section.roles:
            yield f"{name}.roles", section.listen, _joined(section.roles)
    if opcua is not None and not opcua.trusted and (roles := _anonymous(opcua)):
        yield "opcua.anonymous", opcua.listen, _joined(roles)
    if mqtt is not None and mqtt.listen and not (mqtt.tls and mqtt.tls.ca):
        roles = [role for account in mqtt.account if account.name is None for role in account.roles]
        if find_mosquitto() is None:
            yield "mqtt.listen", mqtt.listen, "publish everything, because aMQTT asks for no account"
        elif roles or mqtt.password_file is None:
            yield "mqtt.account", mqtt.listen, _joined(roles or ["read"])
    if fabric is not None and fabric.embedded and fabric.allow and not (fabric.tls and fabric.tls.ca):
        yield "fabric.allow", str(fabric.listen), "publish as the cells that it names"


def other_users() -> list[str]:
    """Return the names of other users who can log in to this host, without root.

    Users whom only a directory service knows are missing.
    """
    return [user.pw_name for user in pwd.getpwall() if _may_log_in(user) and user.pw_uid not in (0, os.geteuid())]


def _may_log_in(user: pwd.struct_passwd) -> bool:
    return FIRST_UID <= user.pw_uid != NOBODY and os.path.basename(user.pw_shell) not in NO_SHELLS  # noqa: PTH119


def _open_grpc(config: Config) -> Iterator[str]:
    """Yield texts that say what clients without token and certificate may do by gRPC."""
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


def _open_mqtt(config: Config) -> Iterator[str]:
    """Yield texts that say what clients without an account may do at shmio's own broker."""
    mqtt = config.mqtt
    if mqtt is None or not mqtt.listen:
        return
    if find_mosquitto() is None:
        yield f"publish everything, values too, by MQTT at {mqtt.listen}, where aMQTT asks for no account"
        return
    free = any(account.name is None and "write" in account.roles for account in mqtt.account)
    if free and not (mqtt.tls and mqtt.tls.ca) and any(source.writable for source in config.source):
        yield f"write by MQTT at {mqtt.listen}"


def _open_opcua(config: Config) -> Iterator[str]:
    """Yield texts that say what clients without account and certificate may do by OPC UA."""
    opcua = config.opcua
    if opcua is None or opcua.trusted:
        return
    if roles := [role for role in _anonymous(opcua) if role != "read"]:
        yield f"{_joined(roles)} by OPC UA at {opcua.listen}"


def _anonymous(opcua: OpcUa) -> Sequence[str]:
    """Return the roles of clients without account and certificate."""
    if opcua.anonymous is not None:
        return opcua.anonymous
    return [] if opcua.account or opcua.client else ROLES


def _open_fabric(config: Config) -> Iterator[str]:
    """Yield a text that says what clients without credentials may do at the embedded NATS server."""
    fabric = config.fabric
    if fabric is None or not fabric.embedded or (fabric.tls and fabric.tls.ca) or not fabric.allow:
        return
    cells = _joined(sorted({pattern for one in fabric.allow for pattern in one.patterns}))
    roles = sorted({role for one in fabric.allow for role in one.roles if role != "read"})
    more = f" and {_joined(roles)} here" if roles else ""
    yield f"publish as the cells {cells}{more} by NATS at {fabric.listen}"


def _open_web(config: Config) -> Iterator[str]:
    """Yield texts that say what users without a token may do on the web page."""
    web = config.web
    if web is not None and (roles := [role for role in web.roles or () if role != "read"]):
        yield f"{_joined(roles)} on the page at {web.listen}"


def _joined(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
