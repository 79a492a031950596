"""A process with readers of a block: threads that follow every frame, and decode one register of each."""

from __future__ import annotations

import argparse
import threading

from common import tell, wait_for_parent

from shmio import attach
from shmio.layout.values.codec import codec
from shmio.segment import Block


class Reader:
    """A thread that follows all frames with a cursor."""

    def __init__(self, block: Block) -> None:
        self._block = block
        self._cursor = block.cursor()
        self._stopping = False
        self.frames = 0
        self.thread = threading.Thread(target=self._follow, daemon=True)
        self.thread.start()

    def _follow(self) -> None:
        decoder = codec(self._block.layout.registers[0], self._block.layout.byte_order)
        while not self._stopping:
            frame = self._cursor.next(timeout_s=0.5)
            if frame is not None:
                decoder.decode(frame.image)
                self.frames += 1

    def stop(self) -> tuple[int, int]:
        """Stop the thread. Return the numbers of frames read and missed."""
        self._stopping = True
        self.thread.join()
        return self.frames, self._cursor.missed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("instance")
    parser.add_argument("source")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    with attach(arguments.instance) as cell:
        block = cell.block(arguments.source)
        readers = [Reader(block) for _ in range(arguments.threads)]
        tell("ready")
        wait_for_parent()
        counts = [reader.stop() for reader in readers]
        tell({"frames": sum(frames for frames, _ in counts), "missed": sum(missed for _, missed in counts)})


if __name__ == "__main__":
    main()
