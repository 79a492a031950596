"""Parse the XML documents of an agent: devices, streams and errors, of versions 1.3 to 2.x.

A document comes from a network. It must have no DTD, so that it has no entities. Its size, depth and number of data
items are limited. Namespaces are not compared, because each version has its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from typing import Final, NamedTuple
from xml.parsers import expat

from shmio.errors import ConnectorError

MAX_DOCUMENT_BYTES: Final = 32 << 20
MAX_DEPTH: Final = 64
MAX_DATA_ITEMS: Final = 100_000
MAX_OBSERVATIONS: Final = 100_000
"""Most observations of wanted data items in one document."""
MAX_TEXT: Final = 1 << 20
"""Longest text of one observation, in characters. A time series is one text."""
MAX_ERROR: Final = 300
_TIME = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d{1,9})\d*)?(Z|[+-]\d\d:\d\d)?", re.ASCII)
_KINDS: Final = frozenset({"Samples", "Events", "Condition"})


class DataItem(NamedTuple):
    """A data item of a device model."""

    id: str
    category: str
    names: tuple[frozenset[str], ...]
    """For each part of the item's path, the names that an address may use: the device, its components, the item."""
    labels: tuple[str, ...]
    """The item's path, with one name for each part."""
    representation: str
    kind: str
    """The type, such as POSITION."""
    units: str

    @property
    def path(self) -> str:
        """The item's path, as messages show it."""
        return "/".join(self.labels)


class Observation(NamedTuple):
    """One value of a data item."""

    item: str
    sequence: int
    source_ns: int
    element: str
    text: str
    native_code: str


@dataclass
class Streams:
    """The content of an MTConnectStreams document."""

    instance_id: str = ""
    next_sequence: int = 0
    last_sequence: int = 0
    observations: list[Observation] = field(default_factory=list)


class _Parser:
    """Feeds expat with limited input, and passes on elements by their local names."""

    def __init__(
        self, root: str, begin: Callable[[str, dict[str, str]], None], end: Callable[[str, str], None]
    ) -> None:
        self._root, self._begin, self._end = root, begin, end
        self._open: list[str] = []
        self._text: list[str] = []
        self._length = self._size = 0
        self._seen = False
        self._error: list[str] | None = None
        self._expat = expat.ParserCreate(namespace_separator=" ")
        self._expat.buffer_text = True
        self._expat.StartDoctypeDeclHandler = self._refuse
        self._expat.StartElementHandler = self._start
        self._expat.EndElementHandler = self._stop
        self._expat.CharacterDataHandler = self._add

    def feed(self, data: bytes) -> None:
        """Parse more of the document. Raise ConnectorError if it is invalid or too large."""
        self._size += len(data)
        if self._size > MAX_DOCUMENT_BYTES:
            raise ConnectorError(f"the agent's document has more than {MAX_DOCUMENT_BYTES >> 20} MiB")
        self._parse(data, last=False)

    def finish(self) -> None:
        """Parse the end. Raise ConnectorError if the document is incomplete, or reports an error of the agent."""
        self._parse(b"", last=True)
        if self._error is not None:
            raise ConnectorError(f"the agent reports: {' '.join(self._error)[:MAX_ERROR] or 'an error'}")

    @property
    def parent(self) -> str:
        """Local name of the element that contains the present one."""
        return self._open[-2] if len(self._open) > 1 else ""

    @property
    def depth(self) -> int:
        """Number of open elements."""
        return len(self._open)

    def _parse(self, data: bytes, *, last: bool) -> None:
        try:
            self._expat.Parse(data, last)
        except expat.ExpatError as error:
            raise ConnectorError(f"the agent's document is not valid XML: {error}") from None
        except (ValueError, OverflowError) as error:
            raise ConnectorError(f"the agent's document is not valid: {str(error)[:MAX_ERROR]}") from None

    def _refuse(self, *_: object) -> None:
        raise ConnectorError("the agent's document has a document type declaration, which is not allowed")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        local = name.rpartition(" ")[2]
        if not self._seen:
            self._seen = True
            if local == "MTConnectError":
                self._error = []
            elif local != self._root:
                raise ConnectorError(f"the agent answers with {local[:40]} where {self._root} is expected")
        if len(self._open) >= MAX_DEPTH:
            raise ConnectorError(f"the agent's document is nested more than {MAX_DEPTH} deep")
        self._open.append(local)
        self._clear()
        if self._error is None:
            self._begin(local, {key.rpartition(" ")[2]: value for key, value in attributes.items()})
        elif "errorCode" in attributes and len(self._error) < 5:
            self._error.append(attributes["errorCode"][:MAX_ERROR])

    def _add(self, text: str) -> None:
        self._length += len(text)
        if self._length > MAX_TEXT:
            raise ConnectorError(f"a text in the agent's document has more than {MAX_TEXT} characters")
        self._text.append(text)

    def _stop(self, name: str) -> None:
        local, text = name.rpartition(" ")[2], "".join(self._text).strip()
        if self._error is None:
            self._end(local, text)
        elif text and len(self._error) < 10:
            self._error.append(text[:MAX_ERROR])
        self._open.pop()
        self._clear()

    def _clear(self) -> None:
        self._text.clear()
        self._length = 0


class DevicesDocument:
    """Parses the answer to a probe: the data items of all devices."""

    def __init__(self) -> None:
        self.items: list[DataItem] = []
        self._parts: list[tuple[int, frozenset[str], str]] = []  # open components: depth, names, label
        self._parser = _Parser("MTConnectDevices", self._begin, self._end)
        self.feed, self.finish = self._parser.feed, self._parser.finish

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        names = frozenset(attributes[key] for key in ("name", "id", "uuid") if attributes.get(key))
        if self._parser.parent in ("Devices", "Components"):
            label = attributes.get("name") or attributes.get("id") or name
            self._parts.append((self._parser.depth, names | {name}, label))
        elif name == "DataItem":
            self._add(names, attributes)

    def _add(self, names: frozenset[str], attributes: dict[str, str]) -> None:
        if len(self.items) >= MAX_DATA_ITEMS:
            raise ConnectorError(f"the agent has more than {MAX_DATA_ITEMS} data items")
        kind, sub = attributes.get("type", ""), attributes.get("subType", "")
        item = attributes.get("id", "")
        self.items.append(
            DataItem(
                item,
                attributes.get("category", ""),
                (*(part for _, part, _ in self._parts), names | {f"{kind}.{sub}" if sub else kind}),
                (*(label for _, _, label in self._parts), attributes.get("name") or item),
                attributes.get("representation", "VALUE"),
                kind,
                attributes.get("units", ""),
            )
        )

    def _end(self, _name: str, _text: str) -> None:
        if self._parts and self._parts[-1][0] == self._parser.depth:
            self._parts.pop()


class StreamsDocument:
    """Parses values: the answer to ``current`` or ``sample``. It keeps only the wanted data items."""

    def __init__(self, wanted: Collection[str]) -> None:
        self.streams = Streams()
        self._wanted = wanted
        self._open: dict[str, str] | None = None
        self._parser = _Parser("MTConnectStreams", self._begin, self._end)
        self.feed = self._parser.feed

    def finish(self) -> Streams:
        """Return the content. Raise ConnectorError if the document is incomplete, or reports an error."""
        self._parser.finish()
        if not self.streams.instance_id:
            raise ConnectorError("the agent's document has no Header with an instanceId")
        self.streams.observations.sort(key=lambda one: one.sequence)
        return self.streams

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        if name == "Header":
            self.streams.instance_id = attributes.get("instanceId", "")[:64]
            self.streams.next_sequence = _whole(attributes.get("nextSequence", ""), "nextSequence")
            self.streams.last_sequence = _whole(attributes.get("lastSequence", "0"), "lastSequence")
        elif self._parser.parent in _KINDS and attributes.get("dataItemId") in self._wanted:
            self._open = attributes

    def _end(self, name: str, text: str) -> None:
        found = self._open
        if found is None or self._parser.parent not in _KINDS:
            return
        self._open = None
        if len(self.streams.observations) >= MAX_OBSERVATIONS:
            raise ConnectorError(f"the agent's document has more than {MAX_OBSERVATIONS} observations")
        self.streams.observations.append(
            Observation(
                found["dataItemId"],
                _whole(found.get("sequence", ""), "sequence"),
                to_ns(found.get("timestamp", "")),
                name,
                text,
                found.get("nativeCode", ""),
            )
        )


def to_ns(text: str) -> int:
    """Return a timestamp as ns since 1970 UTC, or 0 if the text is not a timestamp."""
    match = _TIME.fullmatch(text)
    if match is None:
        return 0
    seconds = _seconds(match[1], match[3] if match[3] not in (None, "Z") else "+00:00")
    if seconds is None:
        return 0
    found = seconds * 1_000_000_000 + int((match[2] or "0").ljust(9, "0"))
    return found if 0 < found < 1 << 63 else 0


@lru_cache(maxsize=1000)  # the observations of a document are of few seconds
def _seconds(moment: str, zone: str) -> int | None:
    """Return whole seconds since 1970 UTC; None if the text is not a moment."""
    try:
        since = datetime.fromisoformat(f"{moment}{zone}").astimezone(UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    except (ValueError, OverflowError):
        return None
    return since.days * 86_400 + since.seconds


def _whole(text: str, name: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 20):
        raise ConnectorError(f"the agent's document has {name} {text[:40]!r}, which is not a number")
    return int(text)
