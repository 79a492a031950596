"""What a relay does to the frames that pass: changes them, drops them, keeps them back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

Edit = Callable[[bytes], bytes | None]
Framing = Callable[[bytes | bytearray], int]


def tpkt(data: bytes | bytearray) -> int:
    """Length of the frame that ``data`` begins with, ISO-on-TCP (RFC 1006); 0 if not known yet."""
    return data[2] << 8 | data[3] if len(data) >= 4 else 0


def reference_edit(change: Callable[[int], int]) -> Edit:
    """An edit of the PDU reference of S7 answers."""

    def edit(frame: bytes) -> bytes:
        reference = change(int.from_bytes(frame[11:13], "big")) & 0xFFFF
        return frame[:11] + reference.to_bytes(2, "big") + frame[13:]

    return edit


class Tampering:
    """The edit that is in force, and the frames kept back. Used by the relay's thread, but for ``frame_held``."""

    def __init__(self, framing: Framing | None) -> None:
        """``framing``: tells where a frame ends; None: what comes at once is a frame."""
        self._framing = framing
        self._edit: Edit | None = None
        self._held: list[bytes] = []
        self.frame_held = threading.Event()
        """Set while a frame is kept back."""

    def begin(self, edit: Edit, frames: int | None) -> None:
        """Pass frames through a function; ``frames``: end after so many."""
        left = frames

        def counted(frame: bytes) -> bytes | None:
            nonlocal left
            if left is not None:
                left -= 1
                if not left:
                    self._edit = None
            return edit(frame)

        self._edit = counted

    def keep(self, frame: bytes) -> None:
        """The edit that keeps frames back."""
        self._held.append(frame)
        self.frame_held.set()

    def end(self) -> list[bytes]:
        """Let all pass as it is; what was kept back."""
        self._edit = None
        self.frame_held.clear()
        held, self._held = self._held, []
        return held

    def passing(self, waiting: bytearray, data: bytes) -> Iterator[bytes]:
        """What passes when more bytes come; those of a frame that is not whole yet are left waiting."""
        waiting += data
        while waiting:
            size = len(waiting)
            if self._edit is not None and self._framing is not None:
                size = self._framing(waiting)
                if not 0 < size <= len(waiting):
                    return
            frame = bytes(waiting[:size])
            del waiting[:size]
            passed = frame if self._edit is None else self._edit(frame)
            if passed:
                yield passed
