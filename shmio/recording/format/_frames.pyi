"""Types of the C extension; see _frames.c."""

from shmio.segment import Frame

def add(
    parts: list[bytes],
    index: list[int],
    channel: int,
    frames: list[tuple[int, Frame]],
    first: int,
    size: int,
    limit: int,
    /,
) -> tuple[int, int]: ...
