"""Chooses the program of the instance's own broker: mosquitto, or aMQTT for development."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Final

from shmio.config import Address, Mqtt
from shmio.errors import ConfigError

PLACES: Final = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""Directories to search after those in PATH, because Debian installs mosquitto in one of them."""
INSTALL: Final = "install mosquitto (Debian: apt install mosquitto)"
EXTRA: Final = "pip install 'shmio[broker]'"
MISSING: Final = f'mqtt.broker: "mosquitto" is not on this machine; {INSTALL}'
NEITHER: Final = (
    f"mqtt.broker: there is no MQTT broker on this machine; {INSTALL}, or, for development on this host only, "
    f"aMQTT ({EXTRA})"
)
EVERYBODY: Final = frozenset(("read", "write"))


def find_mosquitto() -> str | None:
    """Find the program mosquitto.

    Returns:
        The program that the environment variable ``SHMIO_MOSQUITTO`` names; if it is not set, the
        program ``mosquitto`` in PATH or in the usual directories. None if mosquitto was not found,
        or if ``SHMIO_MOSQUITTO`` is empty.

    """
    named = os.environ.get("SHMIO_MOSQUITTO")
    if named is not None:
        return shutil.which(named) if named else None
    return shutil.which("mosquitto", path=os.pathsep.join([os.environ.get("PATH", os.defpath), *PLACES]))


def choose_broker(settings: Mqtt) -> str | None:
    """Choose the program of the instance's own broker.

    Returns:
        The path of mosquitto; None for aMQTT.

    Raises:
        ConfigError: Neither program is installed, or the settings demand mosquitto and only aMQTT
            is installed.

    """
    program = find_mosquitto()
    if program is not None:
        return program
    if settings.broker == "mosquitto":
        raise ConfigError(MISSING)
    for demand in _only_mosquitto(settings):
        raise ConfigError(
            f"{demand}, which needs mosquitto, but mosquitto is not installed; {INSTALL}, or use the broker aMQTT, "
            "which is for development: it listens only on loopback, and everybody may do everything (one "
            '[[mqtt.account]] with roles = ["read", "write"] and no name)'
        )
    check_installed()
    return None


def check_installed() -> None:
    """Check that a broker is installed on this machine.

    Raises:
        ConfigError: Neither mosquitto nor aMQTT is installed.

    """
    if find_mosquitto() is None and find_spec("amqtt") is None:
        raise ConfigError(NEITHER)


def _only_mosquitto(settings: Mqtt) -> Iterator[str]:
    """Yield each setting that aMQTT does not support, as text with its key and meaning."""
    if not Address.parse(str(settings.listen)).loopback:
        yield f"mqtt.listen: other hosts can reach {settings.listen}"
    if settings.tls is not None:
        yield "mqtt.tls: the broker must encrypt its connections"
    if settings.password_file is not None:
        yield "mqtt.password_file: clients must log in"
    if not any(account.name is None and set(account.roles) >= EVERYBODY for account in settings.account):
        yield "mqtt.account: not everybody may read and write"
