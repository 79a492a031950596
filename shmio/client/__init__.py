"""The client of ``shmio.v1``: registers of an instance, on this host or another one, as numpy arrays.

Five lines::

    from shmio.client import connect
    with connect("127.0.0.1:8089") as cell:
        print(cell["cell/Robot_800/Axs1_Pos"])
        for update in cell.subscribe("cell/Robot_*/Axs*_Pos"):
            print(update.cycle, update.quality, update["cell/Robot_800/Axs1_Pos"])

For asyncio, use ``async with connect_aio(…)``. The client has the same methods; await them.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from shmio.client.aio import client
from shmio.client.calls import Stepped, Target
from shmio.client.layout import BlockLayout
from shmio.client.model import Work
from shmio.client.sync.client import Client, Simulation, Steps, Subscription
from shmio.client.sync.events import Events
from shmio.client.sync.injection import Campaign, Shadow
from shmio.client.table import Change, Register, Table
from shmio.client.update import Piece, Snapshot, Update
from shmio.model.clock import Clock
from shmio.model.event import Event, EventKind
from shmio.model.injection import Declared, Injection, InjectionEvent, Lifted, Running
from shmio.model.replay import ReplayChanges, ReplayStatus
from shmio.model.values import Column, Outcome, OutcomeKind, Provenance, Quality

__all__ = [
    "BlockLayout",
    "Campaign",
    "Change",
    "Client",
    "Clock",
    "Column",
    "Declared",
    "Event",
    "EventKind",
    "Events",
    "Injection",
    "InjectionEvent",
    "Lifted",
    "Outcome",
    "OutcomeKind",
    "Piece",
    "Provenance",
    "Quality",
    "Register",
    "ReplayChanges",
    "ReplayStatus",
    "Running",
    "Shadow",
    "Simulation",
    "Snapshot",
    "Stepped",
    "Steps",
    "Subscription",
    "Table",
    "Target",
    "Update",
    "Work",
    "connect",
    "connect_aio",
]

_File = str | PathLike[str] | None


def connect(
    address: str,
    *,
    ca: _File = None,
    certificate: _File = None,
    key: _File = None,
    token: str | None = None,
    token_in_plain_text: bool = False,
    timeout_s: float = 10.0,
) -> Client:
    """Return a client of an endpoint. The client connects at the first call of one of its methods.

    Args:
        address: ``HOST:PORT`` or ``unix:PATH``.
        ca: PEM file of the certificate authority to trust; None: the client does not use TLS.
        certificate: PEM file of a client certificate, if the endpoint needs one; else None.
        key: PEM file of the certificate's key; None without a certificate.
        token: Token of this client, if the endpoint needs one; else None.
        token_in_plain_text: Whether the client may send the token to another host without TLS.
        timeout_s: Time-out in s of each call that the endpoint should answer immediately.

    Raises:
        OSError: A file cannot be read.
        ValueRangeError: The token would go to another host in plain text.
    """
    return Client(Target(address, _path(ca), _path(certificate), _path(key), token, token_in_plain_text), timeout_s)


def connect_aio(
    address: str,
    *,
    ca: _File = None,
    certificate: _File = None,
    key: _File = None,
    token: str | None = None,
    token_in_plain_text: bool = False,
    timeout_s: float = 10.0,
) -> client.Client:
    """Return a client for asyncio, with the arguments of :func:`connect`.

    Create and use the client within an event loop, and await its methods.
    """
    return client.Client(
        Target(address, _path(ca), _path(certificate), _path(key), token, token_in_plain_text), timeout_s
    )


def _path(file: _File) -> Path | None:
    return None if file is None else Path(file)
