"""How far a recording has come with a block."""

from __future__ import annotations

from dataclasses import dataclass, field

from shmio.dump.encoding import Gap, Place, Reason
from shmio.recording.follower import Follower
from shmio.recording.writer import Channels
from shmio.segment import Event, Frame


@dataclass(slots=True)
class _Lost:
    """What could not be taken because there was no room: numbers from, to."""

    first: int
    last: int
    after_ns: int

    @property
    def count(self) -> int:
        return self.last - self.first + 1


@dataclass(slots=True)
class Followed:
    """A block in one file. ``begin``: where that begins; then the last frame and event that are in it, or in a gap."""

    follower: Follower
    begin: Place
    frame: int
    event: int
    log_ns: int
    channels: Channels | None = None
    lost: dict[str, _Lost] = field(default_factory=dict)
    """By what it is."""

    @property
    def place(self) -> Place:
        """Behind what was written last."""
        return Place(self.frame, self.event, self.log_ns)

    @property
    def losses(self) -> int:
        """How many are lost, and not told yet."""
        return sum(lost.count for lost in self.lost.values())

    def come_to(self, what: str, number: int, log_ns: int) -> None:
        """Up to this frame or event it was written, or is in a gap that was."""
        self.log_ns = log_ns
        if what == "frames":
            self.frame = number
        else:
            self.event = number

    def lose(self, item: Frame | Event | Gap) -> int:
        """There is no room for it; how many frames or events that costs."""
        if isinstance(item, Gap):
            what, first, last = item.what, item.first, item.last
        else:
            what, first, last = "frames" if isinstance(item, Frame) else "events", item.number, item.number
        lost = self.lost.setdefault(what, _Lost(first, last, self.log_ns))
        lost.last = last
        return last - first + 1

    def found(self, before_ns: int) -> list[Gap]:
        """What was lost, now that there is room again; it is not kept any longer."""
        block = self.follower.block
        lost, self.lost = self.lost, {}
        return [
            Gap(
                block.source, self.follower.number, what, one.first, one.last, one.count, Reason.NO_ROOM,
                one.after_ns, before_ns,
            )
            for what, one in lost.items()
        ]  # fmt: skip
