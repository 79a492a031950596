"""Check what a configuration needs of the host, before anything starts."""

from __future__ import annotations

import grp
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from shmio import realtime
from shmio.config import Config, Mqtt
from shmio.config.credentials import read_accounts, read_password, read_tokens
from shmio.config.folder import unwritable
from shmio.config.tls import client_context, read_tls, server_context
from shmio.endpoints.mqtt.broker.program import choose_broker
from shmio.errors import ConfigError


def check_host(config: Config, catching: Callable[[], AbstractContextManager[None]]) -> list[str]:
    """Check group, priorities, folders, TLS files and tokens; return warnings. Nothing is created.

    ``catching`` returns a context manager that collects a ConfigError instead of raising it.
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
    with catching():
        warnings += _check_folder("instance.log_dir", config.log_dir)
    if config.recorder:
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


def _check_group(name: str | None) -> None:
    if name is None:
        return
    try:
        gid = grp.getgrnam(name).gr_gid
    except KeyError:
        raise ConfigError(f"instance.group: this host has no group {name!r}") from None
    if os.geteuid() != 0 and gid not in (os.getegid(), *os.getgroups()):
        raise ConfigError(f"instance.group: this user is not in group {name!r}, and so cannot give it the segment")


def _check_priority(key: str, priority: int | None) -> None:
    try:
        if priority is not None:
            realtime.check(priority)
    except ConfigError as error:
        raise ConfigError(f"{key}.{error}") from None


def _check_folder(key: str, folder: Path) -> list[str]:
    """Raise ConfigError if a folder cannot be written; a full disk is only a warning."""
    found = unwritable(folder)
    if found is None:
        return []
    if found.full:
        return [f"{key}: {found.reason}"]
    raise ConfigError(f"{key}: {found.reason}")
