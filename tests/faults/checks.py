"""The invariants of frames, values and processes: what shmio promises, not how it works.

A check gets its data by method calls, so tests can use it without an instance. It reports each
violation as one line to ``complain``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from shmio.segment import Frame, Quality
from tests.faults.configuration import CHAINED, DECLARED
from tests.faults.plc import CHAINED_AT, DECLARED_AT, OTHERS, SHOWN_AT, WORD
from tests.faults.truth import Truth, Words, generations, places

Complain = Callable[[str], None]

HELD_UP_NS = 4_000_000_000
"""Maximum ns between a cycle's due time and its frame; large, because faults pause processes."""

FOREIGN = 60_000
"""Maximum difference between generations in one image, if the PLC's history is not recorded as a :class:`Truth`."""


@dataclass(frozen=True)
class Source:
    """What the checks know of a source. ``truth`` records what the PLC really had; None if nothing records it."""

    name: str
    size: int
    period_ns: int
    stale_ns: int
    tolerance_ns: int
    one_pdu: bool
    truth: Truth | None = None
    landed: Truth | None = None
    """Values written into the words ``command`` and ``remote``, if there is a truth."""
    guarded: Truth | None = None
    """Values written into the word ``guarded``, over whose ``/in`` injections are laid."""
    given: Truth | None = None
    """Values that clients recorded before they injected them into the words ``shown`` and ``guarded``."""
    chained: Truth | None = None
    """Values that clients recorded before they injected them into the word ``chained``.

    The inner client gives multiples of 4, the outer client one more.
    """

    @property
    def oldest_ns(self) -> int:
        """Maximum age of a good value in ns."""
        return self.stale_ns + self.tolerance_ns


@dataclass
class Counts:
    """Counters of one reader."""

    frames: int = 0
    good: int = 0
    missed: int = 0
    values: int = 0
    since_ns: int = 0
    """CLOCK_MONOTONIC when the PLC got the newest good value.

    Without a truth: when the value was published, or when its reader received it.
    """


@dataclass
class FrameCheck:
    """Checks the frames that one reader gets from one source."""

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _last: Frame | None = None
    _words: Words | None = None
    _shown: int = 0
    _chained: int = 0
    _started_ns: int = 0

    def __post_init__(self) -> None:
        self._own = self.source.size if self.source.truth is None else self.source.size - OTHERS
        self._places = places(self._own)

    def begin(self, started_ns: int) -> None:
        """Begin a stream from an instance that started at ``started_ns``. Values must not be older than before."""
        self._last = None
        self._started_ns = started_ns

    def frame(self, frame: Frame, missed: int, now_ns: int) -> None:
        """Check the next frame of the stream.

        Args:
            frame: The frame.
            missed: Number of frames that the reader missed before it.
            now_ns: CLOCK_MONOTONIC when the reader received the frame.
        """
        self.counts.frames += 1
        self.counts.missed += missed
        if self._last is not None:
            self._follows(self._last, frame, missed)
        self._times(frame, now_ns)
        self._quality(frame)
        self._image(frame, repeats=self._last is not None and missed == 0)
        self.age(frame, now_ns)
        self._last = frame

    def _say(self, frame: Frame, problem: str) -> None:
        self.complain(
            f"{self.source.name}: frame {frame.number} (cycle {frame.cycle}, incarnation {frame.incarnation}, "
            f"{frame.quality} {frame.reason!r}, published {frame.publish_ns}): {problem}"
        )

    def _follows(self, last: Frame, frame: Frame, missed: int) -> None:
        if frame.number != last.number + 1 + missed:
            self._say(frame, f"comes after frame {last.number} with {missed} missed")
        if frame.incarnation < last.incarnation:
            self._say(frame, f"incarnation {last.incarnation} came before")
        again = frame.cycle == last.cycle and frame.quality is last.quality is Quality.GOOD
        if again and self.source.given is not None:
            again = frame.raw != last.raw  # a change of an injection publishes the same raw image again
        if frame.cycle < last.cycle or again:
            self._say(frame, f"cycle {last.cycle} came before, in frame {last.number}")
        if frame.publish_ns < last.publish_ns:
            self._say(frame, f"published before frame {last.number}, {last.publish_ns}")

    def _times(self, frame: Frame, now_ns: int) -> None:
        if frame.publish_ns > now_ns:
            self._say(frame, f"published in the future, now is {now_ns}")
        if frame.clock_ns != frame.publish_ns - self._started_ns:
            self._say(frame, f"the clock says {frame.clock_ns}, the instance started at {self._started_ns}")
        late_ns = frame.publish_ns - self._started_ns - frame.cycle * self.source.period_ns
        # A change of an injection repeats the last image with its age; after a restart, the predecessor's image.
        if frame.quality is Quality.GOOD and (late_ns < 0 or late_ns - 1000 * frame.delay_us > HELD_UP_NS):
            age_ms = frame.delay_us / 1e3
            self._say(frame, f"published {late_ns / 1e6:.1f} ms after its cycle was due, its image {age_ms:.1f} ms old")

    def _quality(self, frame: Frame) -> None:
        if (frame.quality is Quality.GOOD) == bool(frame.reason):
            self._say(frame, "good frames have no reason, others have one")

    def _image(self, frame: Frame, *, repeats: bool) -> None:
        if len(frame.image) != self.source.size:
            self._say(frame, f"has {len(frame.image)} bytes")
            return
        if self.source.given is not None:
            self._injected(frame, self.source.given)
        if frame.quality is not Quality.GOOD and not any(frame.raw):
            return  # there was no image yet
        if frame.quality is not Quality.GOOD and repeats and self._last is not None and frame.raw != self._last.raw:
            self._say(frame, "is bad, but its bytes are not those of the frame before")
        words = generations(frame.image[: self._own], self._places)
        self.counts.values += len(words)
        found = [int(word) for word in np.unique(words)]
        if self.source.one_pdu and len(found) > 1:
            self._say(frame, f"mixes generations {found[:8]}")
        if self.source.truth is None:
            if found[-1] - found[0] > FOREIGN:
                self._say(frame, f"contains bytes that the PLC never had: {found[:8]}")
            return
        for generation in found:
            if self.source.truth.since_ns(generation) is None:
                self._say(frame, f"contains {generation:#x}, which the PLC never had, or long ago")
                return
        if self._words is not None and (back := np.flatnonzero(words < self._words)).size:
            place = int(back[0])
            self._say(frame, f"word {place} went back from {self._words[place]} to {words[place]}")
        self._words = words
        if frame.quality is Quality.GOOD and (since_ns := self.source.truth.since_ns(found[-1])) is not None:
            if since_ns > frame.publish_ns:
                self._say(frame, f"contains generation {found[-1]}, which the PLC got later, {since_ns}")
            self.counts.since_ns = max(self.counts.since_ns, since_ns)

    def _injected(self, frame: Frame, given: Truth) -> None:
        """Check the words over which clients inject, where the PLC itself always has 0.

        Consumers must see 0, or a value that a client had recorded before the frame was published.
        """
        places = (SHOWN_AT, DECLARED_AT, CHAINED_AT)
        for raw in (word_at(frame.raw, place) for place in places):
            if raw:
                self._say(frame, f"has {raw}, which was injected, as the PLC's value")
        if _without(frame.image, places) != _without(frame.raw, places):
            self._say(frame, "an injection over one word has changed others")
        if any(frame.raw):
            self._declared(frame)
        shown = word_at(frame.image, SHOWN_AT)
        if not shown:
            return
        since_ns = given.since_ns(shown)
        if since_ns is None or since_ns > frame.publish_ns:
            self._say(frame, f"shows {shown}, which nobody had injected by then")
        elif shown < self._shown:
            self._say(frame, f"shows {shown}, injected before {self._shown}")
        self._shown = shown

    def _declared(self, frame: Frame) -> None:
        """Check declared injections: they apply in every frame, above those of clients."""
        declared, chained = word_at(frame.image, DECLARED_AT), word_at(frame.image, CHAINED_AT) - CHAINED
        if declared != DECLARED:
            self._say(frame, f"shows {declared}, where declared injections make {DECLARED}")
        if self.source.chained is None or not chained:
            return
        origin = chained & ~3
        if chained - origin > 1 or not self._given_by((origin, chained), frame.publish_ns):
            self._say(frame, f"shows {chained} of a chain, which nobody had given by then")
            return
        if origin < self._chained:
            self._say(frame, f"shows {chained} of a chain, given before {self._chained}")
        self._chained = origin

    def _given_by(self, values: Iterable[int], when_ns: int) -> bool:
        assert self.source.chained is not None
        times_ns = [self.source.chained.since_ns(value) for value in values]
        return all(since_ns is not None and since_ns <= when_ns for since_ns in times_ns)

    def age(self, frame: Frame, now_ns: int) -> None:
        """Check that a value that is good now was in the PLC recently."""
        if frame.assess(self.source.stale_ns, now_ns)[0] is not Quality.GOOD or len(frame.image) != self.source.size:
            return
        self.counts.good += 1
        if self.source.truth is None:
            self.counts.since_ns = max(self.counts.since_ns, frame.publish_ns)
            return
        oldest = int(generations(frame.image[: self._own], self._places).min())
        age_ns = self.source.truth.age_ns(oldest, now_ns)
        if age_ns is not None and age_ns > self.source.oldest_ns:
            published_ns = self.source.truth.age_ns(oldest, frame.publish_ns)
            self._say(
                frame,
                f"is good at {now_ns}, but the PLC has not had generation {oldest} for {age_ns / 1e6:.1f} ms "
                f"(when it was published, for {(published_ns or 0) / 1e6:.1f} ms; stale_ms is "
                f"{self.source.stale_ns / 1e6:.0f})",
            )


def word_at(image: bytes, place: int) -> int:
    """Return one of the last words of a block, which the PLC's program does not write."""
    at = len(image) - OTHERS + place
    return int.from_bytes(image[at : at + WORD], "big")


def _without(image: bytes, places: Iterable[int]) -> bytes:
    rest = bytearray(image)
    for place in places:
        at = len(image) - OTHERS + place
        rest[at : at + WORD] = bytes(WORD)
    return bytes(rest)


@dataclass
class ValueCheck:
    """Checks a stream of single values (the block's first word) by the truth."""

    source: Source
    complain: Complain
    counts: Counts = field(default_factory=Counts)
    _last: int = 0

    def value(self, generation: int, now_ns: int, *, slack_ns: int = 0) -> None:
        """Check a good value, read at ``now_ns`` and at most ``slack_ns`` after it was sent."""
        self.counts.values += 1
        if self.source.truth is None:
            self.counts.since_ns = now_ns
            return
        since_ns = self.source.truth.since_ns(generation)
        age_ns = self.source.truth.age_ns(generation, now_ns)
        if since_ns is None or age_ns is None:
            self.complain(f"{self.source.name}: value {generation:#x} is one that the PLC never had")
            return
        if generation < self._last:
            self.complain(f"{self.source.name}: value {generation} comes after {self._last}")
        if age_ns > self.source.oldest_ns + slack_ns:
            self.complain(f"{self.source.name}: value {generation} is good, but {age_ns / 1e6:.1f} ms old")
        self._last = generation
        self.counts.since_ns = max(self.counts.since_ns, since_ns)


@dataclass(frozen=True)
class Process:
    """A process in the instance's status."""

    pid: int | None
    restarts: int


Processes = Mapping[str, Process]

UNTOUCHED_NS = 2_000_000_000
"""Maximum age of values of unaffected readers, on a machine that is not overloaded."""
BYSTANDERS = ("grpc", "stream", "newest")
"""Name prefixes of the readers that follow a source all the time and do not need the broker."""


def check_bystanders(counts: Mapping[str, Counts], now_ns: int, allowed_ns: float, complain: Complain) -> bool:
    """Check readers that do not need the broker while only the broker is broken.

    Returns:
        Whether all of them still get values.
    """
    for name, each in counts.items():
        age_ns = now_ns - each.since_ns
        if name.startswith(BYSTANDERS) and each.since_ns and age_ns > allowed_ns:
            complain(f"{name} has had nothing new for {age_ns / 1e9:.1f} s, and only the broker was broken")
            return False
    return True


def check_restarts(
    before: Processes, after: Processes, hit: set[str], renewed: set[str], *, replaced: bool, complain: Complain
) -> None:
    """Check that the targets of faults were replaced, and no other process.

    Args:
        before: The processes before the faults.
        after: The processes now.
        hit: Names of processes that were restarted.
        renewed: Names of sources that a reload changed. They keep their process, unless a fault of the device
            kept it from handing over; then it was replaced, and its restarts count from 0.
        replaced: Whether the instance has another segment, so that every process must be new.
        complain: Takes each violation.
    """
    if set(before) != set(after):
        complain(f"processes were {sorted(before)}, now they are {sorted(after)}")
        return
    for name, now in after.items():
        then = before[name]
        if now.pid is None:
            complain(f"{name} is not there")
        elif replaced or name in hit:
            if now.pid == then.pid:
                complain(f"{name} was to be replaced, but is pid {now.pid} as before")
            if not (replaced or name in renewed) and now.restarts <= then.restarts:
                complain(f"{name} was restarted, but counts {now.restarts} restarts as before")
        elif now != then and name not in renewed:
            complain(f"{name} was not hit, but went from {then} to {now}")
