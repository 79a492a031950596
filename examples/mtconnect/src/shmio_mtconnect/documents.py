"""Parse the XML documents of an agent: devices, streams and errors, of versions 1.3 to 2.x.

A document comes from a network. It must have no DTD, so that it has no entities. Its size, depth and number of data
items are limited. Namespaces are not compared, because each version has its own.
"""

from __future__ import annotations

import re
from collections.abc import Container
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from operator import attrgetter
from typing import ClassVar, Final, NamedTuple
from xml.parsers import expat

import msgspec

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


class Observation(msgspec.Struct, frozen=True, gc=False):
    """One value of a data item."""

    item: str
    sequence: int
    source_ns: int
    element: str
    text: str
    native_code: str
    quality: str = "VALID"
    """What the agent says about the value: VALID, INVALID or UNVERIFIABLE."""

    @property
    def doubt(self) -> str:
        """Why the value is uncertain; "" if it is not."""
        if self.quality != "VALID":
            return f"the agent reports the quality {self.quality[:40]}"
        return "" if self.source_ns else "its timestamp cannot be read"


@dataclass
class Streams:
    """The content of an MTConnectStreams document."""

    instance_id: str = ""
    next_sequence: int = 0
    last_sequence: int = 0
    observations: list[Observation] = field(default_factory=list)


class _Document:
    """Parses one document: feeds expat with limited input, and checks the root, or takes the errors of the agent.

    A derived class handles the elements in :meth:`_begin` and :meth:`_end`, which call :meth:`_enter` and
    :meth:`_leave`.
    """

    ROOT: ClassVar[str]

    def __init__(self) -> None:
        self._depth = self._size = 0
        self._text: list[str] = []  # of the present element, since the last tag
        self._error: list[str] | None = None
        self._expat = expat.ParserCreate(namespace_separator=" ")
        self._expat.buffer_text = True
        self._expat.StartDoctypeDeclHandler = self._refuse
        self._expat.StartElementHandler = self._begin_root
        self._expat.CharacterDataHandler = self._text.append

    def feed(self, data: bytes) -> None:
        """Parse more of the document. Raise ConnectorError if it is invalid or too large."""
        self._size += len(data)
        if self._size > MAX_DOCUMENT_BYTES:
            raise ConnectorError(f"the agent's document has more than {MAX_DOCUMENT_BYTES >> 20} MiB")
        self._parse(data, last=False)
        self._whole_text()

    def finish(self) -> None:
        """Parse the end. Raise ConnectorError if the document is incomplete, or reports an error of the agent."""
        self._parse(b"", last=True)
        if self._error is not None:
            raise ConnectorError(f"the agent reports: {' '.join(self._error)[:MAX_ERROR] or 'an error'}")

    def _parse(self, data: bytes, *, last: bool) -> None:
        try:
            self._expat.Parse(data, last)
        except expat.ExpatError as error:
            raise ConnectorError(f"the agent's document is not valid XML: {error}") from None
        except (ValueError, OverflowError) as error:
            raise ConnectorError(f"the agent's document is not valid: {str(error)[:MAX_ERROR]}") from None

    def _refuse(self, *_: object) -> None:
        raise ConnectorError("the agent's document has a document type declaration, which is not allowed")

    def _begin_root(self, name: str, attributes: dict[str, str]) -> None:
        if (local := _local(name)) == "MTConnectError":
            self._error = []
            self._expat.StartElementHandler, self._expat.EndElementHandler = self._begin_error, self._end_error
            self._begin_error(name, attributes)
            return
        if local != self.ROOT:
            raise ConnectorError(f"the agent answers with {local[:40]} where {self.ROOT} is expected")
        self._expat.StartElementHandler, self._expat.EndElementHandler = self._begin, self._end
        self._begin(name, attributes)

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        raise NotImplementedError

    def _end(self, name: str) -> None:
        raise NotImplementedError

    def _enter(self) -> int:
        """Begin an element. Return its depth; the root has 1."""
        self._text.clear()
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _too_deep()
        return self._depth

    def _leave(self) -> None:
        """End an element."""
        self._text.clear()
        self._depth -= 1

    def _whole_text(self) -> str:
        """Return the text since the last tag."""
        text = "".join(self._text)
        if len(text) > MAX_TEXT:
            raise ConnectorError(f"a text in the agent's document has more than {MAX_TEXT} characters")
        return text.strip()

    def _begin_error(self, _name: str, attributes: dict[str, str]) -> None:
        self._enter()
        if self._error is not None and "errorCode" in attributes and len(self._error) < 5:
            self._error.append(attributes["errorCode"][:MAX_ERROR])

    def _end_error(self, _name: str) -> None:
        text = self._whole_text()
        if self._error is not None and text and len(self._error) < 10:
            self._error.append(text[:MAX_ERROR])
        self._leave()


def _too_deep() -> ConnectorError:
    return ConnectorError(f"the agent's document is nested more than {MAX_DEPTH} deep")


def _local(name: str) -> str:
    """Return a name without its namespace."""
    return name.rpartition(" ")[2]


class DevicesDocument(_Document):
    """Parses the answer to a probe: the data items of all devices."""

    ROOT = "MTConnectDevices"

    def __init__(self) -> None:
        super().__init__()
        self.items: list[DataItem] = []
        self._open: list[str] = [""]  # names of the open elements
        self._parts: list[tuple[int, frozenset[str], str]] = []  # open components: depth, names, label

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        depth, local, parent = self._enter(), _local(name), self._open[-1]
        self._open.append(local)
        names = frozenset(attributes[key] for key in ("name", "id", "uuid") if attributes.get(key))
        if parent in ("Devices", "Components"):
            label = attributes.get("name") or attributes.get("id") or local
            self._parts.append((depth, names | {local}, label))
        elif local == "DataItem":
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

    def _end(self, _name: str) -> None:
        if self._parts and self._parts[-1][0] == self._depth:
            self._parts.pop()
        self._open.pop()
        self._leave()


class StreamsDocument(_Document):
    """Parses values: the answer to ``current`` or ``sample``. It keeps only the wanted data items."""

    ROOT = "MTConnectStreams"

    def __init__(self, wanted: Container[str]) -> None:
        super().__init__()
        self.streams = Streams()
        self._wanted = wanted
        self._values_depth = 0
        """Depth of the values in the present Samples, Events or Condition; 0 outside of them."""
        self._observations = self.streams.observations
        self._value: dict[str, str] | None = None
        """Attributes of the present value, if it is wanted."""

    def finish(self) -> None:
        """Parse the end. Raise ConnectorError if the document is incomplete, or reports an error of the agent."""
        super().finish()
        if not self.streams.instance_id:
            raise ConnectorError("the agent's document has no Header with an instanceId")
        self.streams.observations.sort(key=attrgetter("sequence"))

    # Both methods run for each value of the stream, so they do the work of _enter and _leave themselves.

    def _begin(self, name: str, attributes: dict[str, str]) -> None:
        self._text.clear()
        depth = self._depth = self._depth + 1
        if depth == self._values_depth:
            if attributes.get("dataItemId") in self._wanted:
                self._value = attributes
            return
        if depth > MAX_DEPTH:
            raise _too_deep()
        if self._values_depth:  # within a value
            return
        local = _local(name)
        if local in _KINDS:
            self._values_depth = depth + 1
        elif local == "Header":
            self.streams.instance_id = attributes.get("instanceId", "")[:64]
            self.streams.next_sequence = _whole(attributes.get("nextSequence", ""), "nextSequence")
            self.streams.last_sequence = _whole(attributes.get("lastSequence", "0"), "lastSequence")

    def _end(self, name: str) -> None:
        if self._value is not None and self._depth == self._values_depth:
            get = self._value.get
            self._value = None
            if len(self._observations) >= MAX_OBSERVATIONS:
                raise ConnectorError(f"the agent's document has more than {MAX_OBSERVATIONS} observations")
            self._observations.append(
                Observation(
                    get("dataItemId", ""),
                    _whole(get("sequence", ""), "sequence"),
                    to_ns(get("timestamp", "")),
                    _local(name),
                    self._whole_text(),
                    get("nativeCode", ""),
                    get("quality", "VALID"),
                )
            )
        elif self._depth < self._values_depth:
            self._values_depth = 0
        self._text.clear()
        self._depth -= 1


@lru_cache(maxsize=1000)  # values that changed together have the same timestamp
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
