"""Eclipse Mosquitto as our own broker: its configuration, and the process itself."""

from __future__ import annotations

import logging
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from shmio.config import Address, Mqtt
from shmio.config.mqtt.accounts import read_accounts
from shmio.endpoints.mqtt.broker.access import BRIDGE, ID, Rights, new_secret, rights
from shmio.endpoints.mqtt.broker.directory import SOCKET, write_private
from shmio.errors import EndpointError

START_S: Final = 10.0
STOP_S: Final = 3.0
MAX_PACKET_BYTES: Final = 1 << 21
MAX_QUEUED_MESSAGES: Final = 100_000
MAX_QUEUED_BYTES: Final = 64 << 20
"""Of what waits for one client that reads slowly: what comes then is dropped, for it alone."""
_STAMP: Final = re.compile(r"^\d+: ")

log = logging.getLogger("shmio.mqtt")


def configuration(settings: Mqtt, place: Path, *, anonymous: bool) -> str:
    """mosquitto.conf(5). ``anonymous``: whether who shows no account is let in."""
    address = Address.parse(str(settings.listen))
    lines = [
        "per_listener_settings true",
        "user root",  # only heeded when started by root: it stays who it is, to die with its parent
        "persistence false",
        "log_dest stderr",
        *(f"log_type {kind}" for kind in ("error", "warning", "notice")),
        f"max_packet_size {MAX_PACKET_BYTES}",
        f"max_queued_messages {MAX_QUEUED_MESSAGES}",
        f"max_queued_bytes {MAX_QUEUED_BYTES}",
        "max_inflight_messages 1000",
        f"listener {address.port} {address.host}",
    ]
    lines += [f"allow_anonymous {'true' if anonymous else 'false'}", f"acl_file {place / 'rights'}"]
    if settings.password_file:
        lines.append(f"password_file {place / 'accounts'}")
    if tls := settings.tls:
        lines += [f"certfile {tls.certificate}", f"keyfile {tls.key}"]
        if tls.ca:
            lines += [f"cafile {tls.ca}", "require_certificate true"]
    # Ours is the last one: who can connect there knows that the broker listens everywhere.
    lines += [f"listener 0 {place / SOCKET}", "allow_anonymous false"]
    lines += [f"password_file {place / 'bridge'}", f"acl_file {place / 'bridge-rights'}"]
    return "".join(f"{line}\n" for line in lines)


def access_rules(given: Mapping[str | None, Rights], *, accounts: bool) -> str:
    """An ACL file. ``accounts``: whether there are any; else a name that a client shows is nobody's, and means nothing.

    What it does not allow is denied, a last will too.
    """
    lines = []
    for name, allowed in sorted(given.items(), key=lambda one: one[0] or ""):  # who shows none comes before all names
        kind = "topic" if accounts else "pattern"
        if name is not None:
            lines.append(f"user {name}")
        if allowed.read:
            lines += [f"{kind} read {topics}" for topics in ("#", "$SYS/#")]
        lines += [f"{kind} write {topics}" for topics in allowed.filters]
    return "".join(f"{line}\n" for line in lines)


class Mosquitto:
    """The process. For the main thread: it dies with the thread that starts it."""

    def __init__(self, program: str, settings: Mqtt, instance: str, place: Path) -> None:
        """Start it. ConfigError: its accounts cannot be read."""
        accounts = read_accounts(settings.password_file, settings.account) if settings.password_file else None
        if accounts is not None:
            write_private(place / "accounts", "".join(f"{name}:{secret}\n" for name, secret in accounts.items()))
        given = rights(settings, instance, accounts)
        write_private(place / "rights", access_rules(given, accounts=accounts is not None))
        write_private(place / "bridge", f"{BRIDGE}:{new_secret(place)}\n")
        write_private(place / "bridge-rights", f"user {BRIDGE}\ntopic readwrite #\n")
        write_private(place / "mosquitto.conf", configuration(settings, place, anonymous=None in given))
        self._socket = place / SOCKET
        self._last = ""
        command = [sys.executable, "-P", "-m", "shmio.endpoints.mqtt.broker.parent_watch", str(os.getpid()), program]
        self._process = subprocess.Popen(
            [*command, "-c", str(place / "mosquitto.conf")],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
        )
        self._reader = threading.Thread(target=self._read, name="broker's log", daemon=True)
        self._reader.start()

    def await_start(self, beat: Callable[[], object]) -> None:
        """Wait until it takes connections. EndpointError: it ends, or takes too long; says what it said last."""
        until_s = time.monotonic() + START_S
        while True:
            self.check()
            with socket.socket(socket.AF_UNIX) as probe:
                try:
                    probe.connect(str(self._socket))
                except OSError:
                    if time.monotonic() > until_s:
                        raise EndpointError(f"mosquitto takes no connections: {self._last}") from None
                else:
                    return
            beat()
            time.sleep(0.02)

    def check(self) -> None:
        """EndpointError: it has ended."""
        code = self._process.poll()
        if code is not None:
            self._reader.join(1.0)
            raise EndpointError(f"mosquitto has ended: {self._last or f'exit status {code}'}")

    def stop(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(1.0)
        if self._process.stderr is not None:
            self._process.stderr.close()

    def _read(self) -> None:
        """Into our log."""
        for line in self._process.stderr or ():
            self._last = ID.sub("…", _STAMP.sub("", line.strip()))
            log.info("mosquitto: %s", self._last)
