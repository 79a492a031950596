"""The injections of SimlogAPI clients, and the shadow topics that come with them."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Final, NamedTuple

from shmio.endpoints.grpc.commands.topics import Shape, TimeTopic, Topics
from shmio.endpoints.grpc.injection.injection import Injection
from shmio.endpoints.grpc.server.connections import Peer, connected, peer_of
from shmio.errors import ConflictError, EndpointError, ValueRangeError
from shmio.layout.topic import Topic, encode_segment, shorten
from shmio.local.writer import RETIRED

MAX_INJECTIONS: Final = 64
"""Bound of this endpoint's injections over one source."""
MAX_PATH: Final = 1024
"""Longest path of a shadow, or prefix, in characters."""
LOOK_S: Final = 0.25
"""Interval of checks for disconnected clients: their injections are to end within a second."""
UNSEEN_S: Final = 10.0
"""How long an injection without a stream stands if its client's connection cannot be seen."""

_MARKS: Final = frozenset(mark.value for mark in TimeTopic)
_SCHEME: Final = re.compile(r"^[^/:]*://")

log = logging.getLogger("shmio.grpc")


class ShadowKind(Enum):
    """The kinds of shadow topics."""

    GIVEN = "gifts"
    """Clients write the injection's values to it, and read what all clients have written."""
    ORIGINALS = "originals"
    """Clients read from it what the injection diverts."""


class Shadow(NamedTuple):
    """A shadow topic of an injection."""

    injection: Injection
    kind: ShadowKind


@dataclass(frozen=True, eq=False)
class _Client:
    """A client that holds an injection without a stream. ``peer``: None if it cannot be seen."""

    peer: Peer | None
    until_s: float


class Shadows:
    """All shadow topics and their injections; an injection is lifted when nobody holds it."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._named: dict[str, Shadow] = {}
        self._holders: dict[Injection, set[object]] = {}
        self._looking: asyncio.Task[None] | None = None

    def find(self, path: str) -> Shadow | None:
        """Return the shadow topic that a path names, or None."""
        return self._named.get(self._topics.name(path)) if self._named else None

    async def lay(
        self, target: Topic, shape: Shape, kinds: Mapping[str, ShadowKind], holder: object, peer: str
    ) -> Injection:
        """Lay an injection with these shadow topics, or join the one that exists.

        Args:
            target: What the injection is over.
            shape: What the target names in the source's layout.
            kinds: The shadow topics, by path.
            holder: Whoever holds the injection until :meth:`release`.
            peer: The client, for the list of all injections.

        Raises:
            ValueRangeError: A shadow topic is the target itself.
            ConflictError: A path is in use for another target.
            EndpointError: There are too many injections.
            CommandError: The source refuses the injection.
            PathError: A reload has removed the source.

        """
        target = replace(target, direction=target.direction or "out")
        injection = self._joined(target, kinds)
        if injection is None:
            feed = self._topics.feed(target.source)
            if sum(other.feed is feed for other in self._holders) >= MAX_INJECTIONS:
                raise EndpointError(f"{MAX_INJECTIONS} injections cover {target.source} already, the maximum: end one")
            injection = Injection(target, shape, feed, f"{shorten(next(iter(kinds)), 60)} of {shorten(peer, 40)}")
            self._named |= {self._topics.name(path): Shadow(injection, kind) for path, kind in kinds.items()}
            self._holders[injection] = set()
            injection.ends[self] = partial(self._forget, injection)
        self._holders[injection].add(holder)
        try:
            await injection.laid()
        except BaseException:
            self.release(injection, holder)
            raise
        return injection

    async def lay_for_client(
        self, target: Topic, shape: Shape, kinds: Mapping[str, ShadowKind], peer: str
    ) -> Injection:
        """Lay an injection as :meth:`lay`; the client's connection holds it until a stream does."""
        seen = peer_of(peer)
        if seen not in await asyncio.to_thread(connected):
            seen = None
        client = _Client(seen, time.monotonic() + UNSEEN_S)
        injection = await self.lay(target, shape, kinds, client, peer)
        if self._looking is None:
            self._looking = asyncio.get_running_loop().create_task(self._look())
        return injection

    def hold(self, injection: Injection, stream: object) -> None:
        """Have a stream hold an injection, in place of clients without a stream."""
        holders = self._holders.get(injection, set())
        holders.difference_update([holder for holder in holders if isinstance(holder, _Client)])
        holders.add(stream)

    def release(self, injection: Injection, holder: object) -> None:
        """End a hold on an injection, which is lifted when its last hold ends."""
        holders = self._holders.get(injection, set())
        if holder in holders:
            holders.remove(holder)
            if not holders:
                injection.end("nobody holds it any more")

    def move(self, sources: Collection[str]) -> None:
        """End the injections over sources whose blocks a reload has replaced."""
        for injection in list(self._holders):
            if injection.target.source in sources:
                injection.end(RETIRED)

    def _joined(self, target: Topic, kinds: Mapping[str, ShadowKind]) -> Injection | None:
        """Return the injection that has these topics. ConflictError: another target has them."""
        found: Injection | None = None
        for path, kind in kinds.items():
            name = self._topics.name(path)
            if name == str(target):
                raise ValueRangeError(f"{shorten(path)} is the target: a shadow needs a path of its own")
            shadow = self._named.get(name)
            if name in _MARKS or (shadow and (shadow.injection.target != target or shadow.kind is not kind)):
                use = f"the shadow of {shadow.injection.target}" if shadow else "served by shmio"
                raise ConflictError(f"{shorten(path)} is {use}: name another path")
            found = shadow.injection if shadow else found
        return found

    def _forget(self, injection: Injection) -> None:
        log.info("injection over %s: %s", injection.target, injection.over)
        del self._holders[injection]
        self._named = {name: shadow for name, shadow in self._named.items() if shadow.injection is not injection}

    async def _look(self) -> None:
        """Release the injections of clients without a stream whose connection has ended."""
        while clients := self._clients():
            await asyncio.sleep(LOOK_S)
            there = await asyncio.to_thread(connected)
            for injection, client in clients:
                gone = time.monotonic() > client.until_s if client.peer is None else client.peer not in there
                if gone:
                    self.release(injection, client)
        self._looking = None

    def _clients(self) -> list[tuple[Injection, _Client]]:
        return [
            (injection, holder)
            for injection, holders in self._holders.items()
            for holder in holders
            if isinstance(holder, _Client)
        ]


def shadow_path(path: str) -> str:
    """Check a path that a client wants for a shadow. ValueRangeError: it is not usable."""
    if not path.strip("/") or len(path) > MAX_PATH or not path.isprintable():
        raise ValueRangeError(f"the path of a shadow has 1 to {MAX_PATH} printable characters, not {shorten(path)!r}")
    return path


def shadow_paths(prefix: str, target: Topic) -> tuple[str, str]:
    """Return the paths of a target's two shadow topics: for given values, and for originals.

    Many targets may share a prefix. ValueRangeError: the prefix is not usable.
    """
    if len(prefix) > MAX_PATH or not prefix.isprintable():
        raise ValueRangeError(f"shadowPathPrefix has at most {MAX_PATH} printable characters, not {shorten(prefix)!r}")
    names = [encode_segment(name) for name in _SCHEME.sub("", prefix).split("/") if name]
    base = "/".join([*names, encode_segment(str(replace(target, direction=target.direction or "out")))])
    return f"SIMLOG://{base}/in", f"SIMLOG://{base}/out"
