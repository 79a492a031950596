"""Computes a digest of what a recording contains, which is the same for equal runs in virtual time."""

from __future__ import annotations

import hashlib

from shmio.recording.dump import Dump
from shmio.recording.format.encoding import encode_event, encode_frame


def digest_of_contents(dump: Dump) -> str:
    """Return the SHA-256 of all frames and events of a recording, source by source.

    It leaves out what differs between two equal runs: times of the host's clocks, the numbers of
    commands and injections, and who sent commands, which names a process.
    """
    found = hashlib.sha256()
    for source in sorted(dump.sources):
        found.update(f"{source}\n".encode())
        for frame in dump.frames(source):
            found.update(encode_frame(frame.item._replace(publish_ns=0)))
        for event in dump.events(source):
            found.update(encode_event(event.item._replace(publish_ns=0, utc_ns=0, command=0, injection=0, by="")))
    return found.hexdigest()
