"""The cells of the fabric, as all pages show them, and the addresses of their pages.

One task reads the registry for all pages, and only while a page shows the cells. What cells write into
the registry may be hostile: it is shortened, and only addresses that are made anew become links.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import re
import socket
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import msgspec

from shmio.errors import ShmioError
from shmio.version import __version__
from shmio.wording import printable

if TYPE_CHECKING:
    from shmio.fabric.client import FabricClient
    from shmio.fabric.fleet import Member

INTERVAL_S: Final = 2.0
"""Wait in s between two readings of the registry. Cells renew their entries as often."""
ANSWER_S: Final = 5.0
"""Maximum time in s that a reading may take."""
MAX_CELLS: Final = 1_000
"""Maximum number of cells that are shown."""
MAX_TEXT: Final = 200
"""Maximum number of characters that are shown of a text in the registry."""
_QUALITIES: Final = ("bad", "uncertain", "good")
_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,251}[A-Za-z0-9])?", re.ASCII)

_log = logging.getLogger("shmio.web")


class Cells:
    """Reads the cells of the fabric while pages show them. Use it in the event loop's thread only."""

    def __init__(self, access: Mapping[str, Any], instance: str) -> None:
        """Create the reader. It does not connect before a page follows it.

        Args:
            access: How to connect, as JSON values of an ``Access``.
            instance: Name of this instance.

        """
        self._access, self._instance, self._host = access, instance, socket.gethostname()
        self._followers = 0
        self._left = asyncio.Event()
        """Set while no page shows the cells."""
        self._task: asyncio.Task[None] | None = None
        self._news = asyncio.Event()
        self._number = 0
        """Number of readings since a page has begun to show the cells."""
        self._members: list[Member] = []
        self._problem = ""
        self._described: dict[str, dict[str, Any]] = {}
        """The last reading, by how a browser names this host."""
        self._read_s: float | None = None
        """Time of the last reading that succeeded, by CLOCK_MONOTONIC in s."""

    @contextmanager
    def followed(self) -> Iterator[None]:
        """Read the cells again and again, while any such block is active."""
        if not self._followers:  # what earlier pages saw is old
            self._number, self._members, self._read_s = 0, [], None
        self._followers += 1
        self._left.clear()
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._run())
        try:
            yield
        finally:
            self._followers -= 1
            if not self._followers:
                self._left.set()

    async def newer(self, number: int) -> int:
        """Wait for a reading after the one with this number, and return its number. The first one has number 1."""
        while self._number <= number:
            await self._news.wait()
        return self._number

    def described(self, page_host: str) -> dict[str, Any]:
        """Return the cells, and what is wrong with the last reading.

        Args:
            page_host: The Host header of the page's requests: how its browser names this host.

        """
        if page_host not in self._described:
            self._described[page_host] = self._describe(page_host)
        return self._described[page_host]

    def _describe(self, page_host: str) -> dict[str, Any]:
        return {
            "problem": self._problem,
            "old_s": None if self._read_s is None else time.monotonic() - self._read_s,
            "version": __version__,
            "more": len(self._members) > MAX_CELLS,
            "cells": [self._row(one, page_host) for one in self._members[:MAX_CELLS]],
        }

    def _row(self, member: Member, page_host: str) -> dict[str, Any]:
        from shmio.fabric.machine import machine  # noqa: PLC0415  pages of instances without a fabric do not need it

        here = member.host == self._host and member.machine in ("", machine())
        found = Counter(one.quality if one.quality in _QUALITIES else "bad" for one in member.sources)
        own = here and member.instance == self._instance
        url, why = ("", "this page") if own else page_address(member.web, member.host, page_host, here=here)
        return {
            "cell": _short(member.cell),
            "state": _short(member.state),
            "host": _short(member.host),
            "instance": _short(member.instance),
            "version": _short(member.version),
            "age_s": member.age_s,
            "qualities": {quality: found[quality] for quality in _QUALITIES if found[quality]},
            "notes": [_short(note) for note in member.notes],
            "url": url,
            "why": why,
        }

    async def _run(self) -> None:
        while self._followers:  # a page may come back while the connection is being closed
            await self._read()
        self._task = None

    async def _read(self) -> None:
        """Read the registry over one connection until the connection fails, or no page shows the cells."""
        from nats.errors import Error  # noqa: PLC0415  pages of instances without a fabric do not need it

        from shmio.fabric.connection import Access, connect, reason  # noqa: PLC0415
        from shmio.fabric.fleet import members  # noqa: PLC0415
        from shmio.fabric.registry import Registry  # noqa: PLC0415

        access = msgspec.convert(self._access, Access)
        client: FabricClient | None = None
        try:
            client = await connect(access, f"shmio page of {self._instance}", patient=False)
            async with asyncio.timeout(ANSWER_S):
                registry = await Registry.open(client)
            while self._followers:
                async with asyncio.timeout(ANSWER_S):
                    found = await members(registry, MAX_CELLS + 1)
                self._members, self._read_s = found, time.monotonic()
                self._tell("")
                await self._pause()
        except ShmioError as error:
            self._tell(str(error))
        except (TimeoutError, OSError, Error) as error:
            self._tell(f"{access}: {reason(error)}")
        except Exception:  # noqa: BLE001  pages are told
            _log.exception("the cells of the fabric cannot be read")
            self._tell("the cells cannot be read; the log of the process web has the reason")
        else:
            return
        finally:
            if client is not None:
                await client.close()
        await self._pause()

    def _tell(self, problem: str) -> None:
        self._problem = problem
        self._number += 1
        self._described.clear()
        self._news.set()
        self._news = asyncio.Event()

    async def _pause(self) -> None:
        """Wait until the next reading is due, or no page shows the cells."""
        try:
            async with asyncio.timeout(INTERVAL_S):
                await self._left.wait()
        except TimeoutError:
            return


def page_address(web: str, host: str, page_host: str, *, here: bool) -> tuple[str, str]:
    """Return the URL at which a browser can open a cell's page; without one, an empty text and the reason.

    Args:
        web: The address of the cell's page as the registry has it.
        host: Name of the cell's host.
        page_host: How the browser names the host of this page, such as ``10.76.0.5:8080``.
        here: Whether the cell runs on the host of this page.

    """
    if not web:
        return "", "it has no page"
    try:
        parts = urlsplit(web[: MAX_TEXT + 1])
        name, port = parts.hostname or "", parts.port
    except ValueError:
        name = ""
    if not name or len(web) > MAX_TEXT or parts.scheme not in ("http", "https") or "@" in parts.netloc:
        return "", f"not the address of a page: {_short(web)}"
    address = _ip(name)
    if address is not None and address.is_unspecified:  # it listens on all addresses of its host
        name = _host_of(page_host) if here else host
        address = _ip(name)
    elif (address is not None and address.is_loopback) or name == "localhost":
        if not here:
            return "", f"only on the host {_short(host)}, at {_short(web)}"
        if not _loopback(_host_of(page_host)):
            return "", f"only on this server's host, at {_short(web)}"
    if address is None and not _NAME.fullmatch(name):
        return "", f"not the address of a page: {_short(web)}"
    shown = f"[{address}]" if address is not None and address.version == 6 else name
    return f"{parts.scheme}://{shown}{'' if port is None else f':{port}'}/", ""


def _ip(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return None if "%" in name else ipaddress.ip_address(name)
    except ValueError:
        return None


def _loopback(name: str) -> bool:
    address = _ip(name)
    return name == "localhost" if address is None else address.is_loopback


def _host_of(header: str) -> str:
    """Return the host in a Host header."""
    try:
        return urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return ""


def _short(text: str) -> str:
    return printable(text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}…")
