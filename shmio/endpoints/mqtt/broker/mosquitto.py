"""Runs Eclipse Mosquitto as the instance's own broker: its configuration, access rules, and process.

Only the bridge may publish values, status and results.
"""

from __future__ import annotations

import logging
import re
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from shmio.config import Address, Mqtt, MqttAccount
from shmio.config.credentials import read_accounts
from shmio.endpoints.mqtt.broker.directory import BRIDGE, ID, SOCKET, new_secret, secret_id, secret_of, write_private
from shmio.endpoints.server_process import Probe, ServerProcess

STOP_S: Final = 3.0
MAX_PACKET_BYTES: Final = 1 << 21
MAX_QUEUED_MESSAGES: Final = 100_000
MAX_QUEUED_BYTES: Final = 64 << 20
"""Maximum size of the queue for a slow client, in bytes. If the queue is full, the client loses new messages."""
MAX_LEVELS: Final = 64
"""Maximum number of levels in the path of a register that clients can write by MQTT."""
READERS: Final = MqttAccount(roles=["read"])
"""The account of clients that have no ``[[mqtt.account]]``."""
PINGREQ: Final = b"\xc0\0"
_STAMP: Final = re.compile(r"^\d+: ")

log = logging.getLogger("shmio.mqtt")


def configuration(settings: Mqtt, place: Path, *, anonymous: bool) -> str:
    """Return the text of mosquitto.conf(5) for these settings.

    Args:
        settings: The configuration's ``[mqtt]`` section.
        place: The broker's directory.
        anonymous: Whether clients without an account may connect.

    """
    address = Address.parse(str(settings.listen))
    lines = [
        "per_listener_settings true",
        "user root",  # matters only if root starts it: under another user it would not die with its parent
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
    # Our socket comes last: when it accepts connections, the other listener already does.
    lines += [f"listener 0 {place / SOCKET}", "allow_anonymous false"]
    lines += [f"password_file {place / 'bridge'}", f"acl_file {place / 'bridge-rights'}"]
    return "".join(f"{line}\n" for line in lines)


class Rights(NamedTuple):
    """The rights of an account.

    Attributes:
        read: True if the account may subscribe to all topics.
        filters: Topic filters; the account may publish on the topics that match one of them.
    """

    read: bool
    filters: Sequence[str]


def rights(settings: Mqtt, instance: str, accounts: Iterable[str] | None) -> dict[str | None, Rights]:
    """Return the rights of each account, by its name. The name None stands for clients without an account.

    Args:
        settings: The configuration's ``[mqtt]`` section.
        instance: Name of the instance.
        accounts: Names of the accounts that have a password; None if passwords are not used.

    """
    given = {account.name: account for account in settings.account}
    for name in [None] if accounts is None else accounts:
        given.setdefault(name, READERS)
    commands = list(_commands(settings, instance))
    return {
        name: Rights("read" in account.roles, [*account.publish, *commands] if "write" in account.roles else [])
        for name, account in given.items()
    }


def _commands(settings: Mqtt, instance: str) -> Iterator[str]:
    prefix = settings.prefix or f"shmio/{instance}"
    for levels in range(1, MAX_LEVELS + 1):
        yield f"{prefix}/+/{'+/' * levels}in"
    if node := settings.sparkplug:
        name = node.node or instance
        yield from (f"spBv1.0/{node.group}/NCMD/{name}", f"spBv1.0/{node.group}/DCMD/{name}/+", "spBv1.0/STATE/+")


def access_rules(given: Mapping[str | None, Rights], *, accounts: bool) -> str:
    """Return the text of an ACL file. Mosquitto denies everything that the file does not allow.

    Args:
        given: The rights of each account, by its name. The name None stands for clients without an
            account.
        accounts: Whether accounts are in use. If not, mosquitto ignores the user names of clients.

    """
    lines = []
    # Clients without an account come before all names.
    for name, allowed in sorted(given.items(), key=lambda one: one[0] or ""):
        kind = "topic" if accounts else "pattern"
        if name is not None:
            lines.append(f"user {name}")
        if allowed.read:
            lines += [f"{kind} read {topics}" for topics in ("#", "$SYS/#")]
        lines += [f"{kind} write {topics}" for topics in allowed.filters]
    return "".join(f"{line}\n" for line in lines)


class Mosquitto:
    """The mosquitto process. Start it from the main thread: see :class:`ServerProcess`."""

    def __init__(self, program: str, settings: Mqtt, instance: str, place: Path) -> None:
        """Start mosquitto.

        Raises:
            ConfigError: The file with the accounts cannot be read.

        """
        accounts = read_accounts(settings.password_file, settings.account) if settings.password_file else None
        if accounts is not None:
            write_private(place / "accounts", "".join(f"{name}:{secret}\n" for name, secret in accounts.items()))
        given = rights(settings, instance, accounts)
        write_private(place / "rights", access_rules(given, accounts=accounts is not None))
        write_private(place / "bridge", f"{BRIDGE}:{new_secret(place)}\n")
        write_private(place / "bridge-rights", f"user {BRIDGE}\ntopic readwrite #\n")
        write_private(place / "mosquitto.conf", configuration(settings, place, anonymous=None in given))
        self._socket = place / SOCKET
        command = [program, "-c", str(place / "mosquitto.conf")]
        probe = Probe(self._connect, _connect_packet(secret_of(str(self._socket))), PINGREQ)
        self._process = ServerProcess("mosquitto", command, STOP_S, _read, probe)

    def await_start(self, beat: Callable[[], object]) -> None:
        """Wait until mosquitto accepts connections; see :meth:`ServerProcess.await_start`."""

        def accepts() -> bool:
            with socket.socket(socket.AF_UNIX) as probe:
                probe.connect(str(self._socket))
            return True

        self._process.await_start(accepts, beat)

    def _connect(self) -> socket.socket:
        probe = socket.socket(socket.AF_UNIX)
        probe.setblocking(False)
        probe.connect(str(self._socket))
        return probe

    @property
    def problem(self) -> str:
        """The problem of the running mosquitto; empty if there is none."""
        return self._process.problem

    def check(self) -> None:
        """Check that mosquitto is running and answers; raise EndpointError if it has ended or hangs."""
        self._process.check()

    def stop(self) -> None:
        """Stop mosquitto."""
        self._process.stop()


def _connect_packet(secret: str) -> bytes:
    """Return a CONNECT packet with the bridge's account, and without keep-alive (MQTT 3.1.1, section 3.1)."""
    fields = [part.encode() for part in (secret_id("watch", secret), BRIDGE, secret)]
    body = b"\0\4MQTT\4\xc2\0\0" + b"".join(len(one).to_bytes(2, "big") + one for one in fields)
    return bytes((0x10, len(body))) + body  # the secret is short enough for a length of one byte


def _read(line: str) -> str:
    """Copy a line of mosquitto's log to the log of this process, and return it."""
    text = ID.sub("…", _STAMP.sub("", line))
    log.info("mosquitto: %s", text)
    return text
