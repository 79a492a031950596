"""The injections that clients have laid through this endpoint, and the topics that these bring."""

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

from shmio.endpoints.grpc.commands.path_kind import Shape
from shmio.endpoints.grpc.commands.topics import TimeTopic, Topics
from shmio.endpoints.grpc.injection.injection import Injection
from shmio.endpoints.grpc.server.connections import Peer, connected, peer_of
from shmio.errors import ConflictError, EndpointError, ValueRangeError
from shmio.layout.topic import Topic, encode_segment, shorten
from shmio.local.writer import RETIRED

MAX_INJECTIONS: Final = 64
"""Of this endpoint, over one source."""
MAX_PATH: Final = 1024
"""Characters of a shadow's path, or of a prefix."""
LOOK_S: Final = 0.25
"""How often it is looked whether clients without a stream are still there: a shadow is to go within a second."""
UNSEEN_S: Final = 10.0
"""So long an injection stands without a stream if it cannot be seen whether its client is there."""

_MARKS: Final = frozenset(mark.value for mark in TimeTopic)
_SCHEME: Final = re.compile(r"^[^/:]*://")

log = logging.getLogger("shmio.grpc")


class ShadowKind(Enum):
    """What a topic of an injection is."""

    GIVEN = "gifts"
    """Clients write to it, and read what all of them have written."""
    ORIGINALS = "originals"
    """Clients read what the injection diverts."""


class Shadow(NamedTuple):
    """One topic of an injection."""

    injection: Injection
    kind: ShadowKind


@dataclass(frozen=True, eq=False)
class _Client:
    """Who holds an injection without a stream. ``peer``: None if it cannot be seen whether its connection stands."""

    peer: Peer | None
    until_s: float


class Shadows:
    """All of them. One is lifted when nobody holds it any more."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._named: dict[str, Shadow] = {}
        self._holders: dict[Injection, set[object]] = {}
        self._looking: asyncio.Task[None] | None = None

    def find(self, path: str) -> Shadow | None:
        """The topic that a path names, if it is one of an injection."""
        return self._named.get(self._topics.name(path)) if self._named else None

    async def lay(
        self, target: Topic, shape: Shape, kinds: Mapping[str, ShadowKind], holder: object, peer: str
    ) -> Injection:
        """Have an injection with these topics laid, or join the one that there is; the holder holds it.

        ValueRangeError: a topic is the target itself; ConflictError: a path is in use for another target;
        EndpointError: too many; CommandError: the source refuses; PathError: a reload has removed it. ``peer``: who
        asks, for the list of all injections.
        """
        target = replace(target, direction=target.direction or "out")
        injection = self._joined(target, kinds)
        if injection is None:
            feed = self._topics.feed(target.source)
            if sum(other.feed is feed for other in self._holders) >= MAX_INJECTIONS:
                raise EndpointError(f"{MAX_INJECTIONS} injections stand on {target.source} already: end one")
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
        """The same for one who has no stream of it yet: its connection holds it, until a stream does."""
        seen = peer_of(peer)
        if seen not in await asyncio.to_thread(connected):
            seen = None
        client = _Client(seen, time.monotonic() + UNSEEN_S)
        injection = await self.lay(target, shape, kinds, client, peer)
        if self._looking is None:
            self._looking = asyncio.get_running_loop().create_task(self._look())
        return injection

    def hold(self, injection: Injection, stream: object) -> None:
        """Have a stream hold an injection, instead of those who have none."""
        holders = self._holders.get(injection, set())
        holders.difference_update([holder for holder in holders if isinstance(holder, _Client)])
        holders.add(stream)

    def release(self, injection: Injection, holder: object) -> None:
        """Let go; the last one has it lifted."""
        holders = self._holders.get(injection, set())
        if holder in holders:
            holders.remove(holder)
            if not holders:
                injection.end("nobody holds it any more")

    def move(self, sources: Collection[str]) -> None:
        """These sources have other blocks by now: what lay over the ones before is gone."""
        for injection in list(self._holders):
            if injection.target.source in sources:
                injection.end(RETIRED)

    def _joined(self, target: Topic, kinds: Mapping[str, ShadowKind]) -> Injection | None:
        """The injection that has these topics; ConflictError: they are another one's."""
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
        """Let go for clients without a stream whose connection has ended."""
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
    """A path that a client wants for a shadow; ValueRangeError: it cannot be one."""
    if not path.strip("/") or len(path) > MAX_PATH or not path.isprintable():
        raise ValueRangeError(f"the path of a shadow has 1 to {MAX_PATH} printable characters, not {shorten(path)!r}")
    return path


def shadow_paths(prefix: str, target: Topic) -> tuple[str, str]:
    """The paths of a target's shadow under a prefix, which many targets may share: to give values, and for originals.

    ValueRangeError: the prefix cannot be one.
    """
    if len(prefix) > MAX_PATH or not prefix.isprintable():
        raise ValueRangeError(f"shadowPathPrefix has at most {MAX_PATH} printable characters, not {shorten(prefix)!r}")
    names = [encode_segment(name) for name in _SCHEME.sub("", prefix).split("/") if name]
    base = "/".join([*names, encode_segment(str(replace(target, direction=target.direction or "out")))])
    return f"SIMLOG://{base}/in", f"SIMLOG://{base}/out"
