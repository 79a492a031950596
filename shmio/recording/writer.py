"""Writes a recording as an MCAP file.

The file has channels for the frames and the events of each block, and for gaps, steps and process
changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from shmio.layout.model import Layout
from shmio.recording.format.encoding import (
    ABOUT,
    EVENT,
    EVENT_SCHEMA,
    FRAME_V2,
    FRAME_V2_SCHEMA,
    GAP_SCHEMA,
    GAPS_TOPIC,
    PLACES,
    PLAIN,
    PROCESS_SCHEMA,
    PROCESSES_TOPIC,
    PROFILE,
    STEP_SCHEMA,
    STEPS_TOPIC,
    BlockPosition,
    Gap,
    ProcessChange,
    StepMark,
    encode_event,
    encode_json,
    encode_position,
)
from shmio.recording.format.mcap_writer import McapWriter, Output
from shmio.recording.reading.part import DumpBlock
from shmio.segment import Block, Event, Frame
from shmio.version import __version__

JSON: Final = "application/json"
TOML: Final = "application/toml"
TEXT: Final = "text/plain"


def layout_files(layout: Layout) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the data of each attachment that describes a layout.

    If the layout has tag tables over the block, a second attachment is the layout without them. It
    is for readers before version 0.2, which refuse a layout whose registers overlap.
    """
    for one in dict.fromkeys((layout.base.hash, layout.hash)):
        data = (layout if one == layout.hash else layout.base).to_json()
        yield f"layouts/{one.hex()}.json", data


@dataclass(frozen=True, slots=True)
class Channels:
    """The numbers of a block's channels."""

    frames: int
    events: int


class Writer:
    """Writes one recording. Use it from one thread only. Log times (``log_ns``) are in ns."""

    def __init__(self, output: Output, about: Mapping[str, str]) -> None:
        """Begin the recording. ``about`` is the metadata about the instance."""
        self._output = output
        self._mcap = McapWriter(output, PROFILE, f"shmio {__version__}")
        self._mcap.add_metadata(ABOUT, about)
        self._schemas: dict[str, int] = {}
        self._own: dict[str, int] = {}
        self.flush()

    def places(self, places: Mapping[int, BlockPosition]) -> None:
        """Write the position at which the previous recording ended, for each block, by its section."""
        if places:
            self._mcap.add_metadata(PLACES, {str(section): encode_position(place) for section, place in places.items()})

    def attach(self, name: str, media_type: str, data: bytes, now_ns: int, changed_ns: int = 0) -> None:
        """Attach a file with the content ``data``.

        Args:
            name: Name of the attachment.
            media_type: Media type of the file.
            data: Content of the file.
            now_ns: The present log time, in ns.
            changed_ns: UTC of the file's last change, in ns; 0 if unknown.
        """
        self._mcap.add_attachment(changed_ns, now_ns, name, media_type, data)

    def attach_layout(self, layout: Layout, now_ns: int) -> None:
        """Attach a layout; see :func:`layout_files`."""
        for name, data in layout_files(layout):
            self.attach(name, JSON, data, now_ns)

    def open_block(
        self,
        block: Block | DumpBlock,
        number: int,
        after_frame: int,
        after_event: int,
        layout: Layout | None = None,
        of: str = "",
    ) -> Channels:
        """Create the channels of a block, whose layout is already attached.

        Args:
            block: The block.
            number: Number of the block in this recording.
            after_frame: Number of the frame before the first recorded frame.
            after_event: Number of the event before the first recorded event.
            layout: Layout of the recorded registers; None for the layout of the block.
            of: Hash of the source's whole layout, if ``block`` has only a part of it; else empty.
        """
        layout = layout or block.layout
        self.flush()  # readers without an index need a channel's record in the chunk of its first message
        about = {
            "source": block.source,
            "block": str(number),
            "section": str(block.section),
            "layout": layout.base.hash.hex(),
            "period_ns": str(block.period_ns),
            "stale_ns": str(block.stale_ns),
        }
        if of or layout.hash != block.layout.hash:
            about["of"] = of or block.layout.hash.hex()
        if layout.hash != layout.base.hash:
            about["names"] = layout.hash.hex()
        frames, events = about | {"after": str(after_frame)}, about | {"after": str(after_event)}
        return Channels(
            self._mcap.register_channel(
                f"{block.source}/frames", FRAME_V2, self._schema(FRAME_V2, FRAME_V2_SCHEMA), frames
            ),
            self._mcap.register_channel(f"{block.source}/events", EVENT, self._schema(EVENT, EVENT_SCHEMA), events),
        )

    def _schema(self, name: str, text: bytes) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._mcap.register_schema(name, "text/plain", text)
        return self._schemas[name]

    def frame(self, channels: Channels, frame: Frame, log_ns: int) -> None:
        """Add a frame with the log time ``log_ns``."""
        self.frames(channels, [(log_ns, frame)])

    def frames(self, channels: Channels, frames: list[tuple[int, Frame]]) -> None:
        """Add frames, each with its log time."""
        self._mcap.add_frames(channels.frames, frames)

    def event(self, channels: Channels, event: Event, log_ns: int) -> None:
        """Add an event with the log time ``log_ns``."""
        publish_ns = event.utc_ns if event.utc_ns > 0 else log_ns
        message = log_ns, publish_ns, event.number & 0xFFFFFFFF, (encode_event(event),)
        self._mcap.add_messages(channels.events, [message])

    def gap(self, gap: Gap, log_ns: int) -> None:
        """Add a gap. Call this before you add the entry that follows the gap."""
        channel = self._channel(GAPS_TOPIC, "shmio.gap.v1", GAP_SCHEMA)
        self._mcap.add_messages(channel, [(log_ns, log_ns, 0, (encode_json(gap),))])

    def step(self, mark: StepMark, log_ns: int) -> None:
        """Add the end of a step. Call this after you have added all frames of the step."""
        channel = self._channel(STEPS_TOPIC, "shmio.step.v1", STEP_SCHEMA)
        self._mcap.add_messages(channel, [(log_ns, log_ns, mark.step & 0xFFFFFFFF, (encode_json(mark),))])

    def process(self, change: ProcessChange, log_ns: int) -> None:
        """Add a process change."""
        channel = self._channel(PROCESSES_TOPIC, "shmio.process.v1", PROCESS_SCHEMA)
        self._mcap.add_messages(channel, [(log_ns, log_ns, 0, (encode_json(change),))])

    def _channel(self, topic: str, schema: str, text: bytes) -> int:
        """Return the number of a channel that belongs to no block. Create it if necessary."""
        if topic not in self._own:
            self.flush()
            number = self._mcap.register_schema(schema, "jsonschema", text)
            self._own[topic] = self._mcap.register_channel(topic, PLAIN, number)
        return self._own[topic]

    def flush(self) -> None:
        """End the present chunk, and write it to the output."""
        self._mcap.flush()

    def finish(self) -> None:
        """Close the recording: write its index and footer."""
        self._mcap.finish()
        self._output.flush()
