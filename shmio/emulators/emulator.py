"""An emulated S7 controller: a cyclic program, and a server that gives clients access to its memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Final, Self

import msgspec
from snap7.server import CPUState
from snap7.type import SrvArea

from shmio.config.address import Address
from shmio.emulators.areas import Place, TableMemory, is_table, place_name
from shmio.emulators.cycle import Cycle
from shmio.emulators.programs import BUILT_IN, Idle, UserCode, program
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.errors import ConfigError, SnapshotError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.s7.address import Area
from shmio.model.snapshot import decode_part

AREAS: Final[Mapping[Area, SrvArea]] = {
    Area.INPUT: SrvArea.PE,
    Area.OUTPUT: SrvArea.PA,
    Area.MARKER: SrvArea.MK,
    Area.TIMER: SrvArea.TM,
    Area.COUNTER: SrvArea.CT,
}
"""The areas that are not data blocks, with python-snap7's names."""


class Emulator:
    """Runs a program on one data block or tag table, and serves this and further ones over S7.

    The further blocks and tables have no program. You can start an emulator only once.

    Clients read and write between cycles, never within one. A client that stops the emulated CPU
    stops the program and its time, but not the server, as with a real controller.
    """

    def __init__(
        self,
        layout: Layout,
        program_name: str,
        listen: Address,
        *,
        db_number: int | None = None,
        others: Sequence[Layout] = (),
        max_clients: int = 16,
        options: ServerOptions | None = None,
        code: UserCode = BUILT_IN,
    ) -> None:
        """Prepare the emulator.

        Args:
            layout: The layout of the program's block, or a tag table with addresses.
            program_name: The program to run.
            listen: The address to listen on.
            db_number: The block's number; default: the layout's own.
            others: Blocks without a program, served under their own numbers, and tag tables.
            max_clients: Maximum number of clients at a time.
            options: Limits and faults of the server.
            code: What the program needs if it is a class of the user.

        Raises:
            ConfigError: There is no such program, the layout does not suit it, a number is missing
                or used twice, or a block is too short for a tag table.

        """
        self._program = program(program_name, layout, code)
        self._server = S7Server(listen, max_clients=max_clients, options=options)
        self._memory: dict[Place, bytearray] = {}
        self._table = TableMemory(layout) if is_table(layout) else None
        self._frame = bytearray(layout.size) if self._table else self._serve(layout, db_number)
        for other in others:
            if not is_table(other):
                self._serve(other)
        tables = [TableMemory(one) for one in others if is_table(one)]
        self._serve_tables([self._table, *tables] if self._table else tables)
        self.cycle = Cycle(
            self._program.period_ms / 1000,
            self._step,
            f"program-{program_name}",
            lambda: bool(self._server.cpu_state == CPUState.RUN),
        )

    @property
    def address(self) -> Address:
        """Address on which the server listens. Raises ShmioError before the start."""
        return self._server.address

    def start(self) -> None:
        """Run the first cycle, listen, and continue in threads.

        Raises:
            EndpointError: The address is not available.

        """
        self.cycle.first()
        self._server.start()
        self.cycle.start()

    def stop(self) -> None:
        """Stop the server and the program; return when all threads have ended."""
        self._server.stop()
        self.cycle.stop()

    def save(self) -> bytes:
        """Return the state of the memory and the program, for a snapshot.

        Raises:
            SnapshotError: The CPU is not in RUN, or the program cannot save its state.
            ModelError: The program's code failed.

        """
        if self._server.cpu_state != CPUState.RUN:
            raise SnapshotError("its CPU is not in RUN; start it first")
        with self._server.lock:
            memory = [bytes(area) for area in self._memory.values()]
            return msgspec.msgpack.encode((bytes(self._frame), memory, self._program.save()))

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it.

        Raises:
            SnapshotError: The state is damaged, or does not fit the controller.

        """
        if self._server.cpu_state != CPUState.RUN:
            raise SnapshotError("its CPU is not in RUN; start it first")
        frame, memory, program_state = decode_part(data, tuple[bytes, list[bytes], bytes])
        areas = list(self._memory.values())
        if len(frame) != len(self._frame) or list(map(len, memory)) != list(map(len, areas)):
            raise SnapshotError("its memory has other areas")
        restore_program = self._program.prepare_restore(program_state)

        def restore() -> None:
            with self._server.lock:
                restore_program()
                self._frame[:] = frame
                for area, content in zip(areas, memory, strict=True):
                    area[:] = content

        return restore

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    def _serve(self, layout: Layout, number: int | None = None) -> bytearray:
        """Serve a block with its initial values, under ``number`` or the block's own number."""
        number = layout.number if number is None else number
        if number is None:
            raise ConfigError(
                f"dbNumber: this key is needed, because the layout {layout.name!r} has no number in its name"
            )
        frame, _ = initial_frame(layout)
        self._server.add_block(number, frame)
        self._memory[Area.BLOCK, number] = frame
        return frame

    def _serve_tables(self, tables: Sequence[TableMemory]) -> None:
        """Serve the memory areas that tables need and that are not served yet; store the tables' initial values."""
        present = frozenset(self._memory)
        sizes: dict[Place, int] = {}
        for table in tables:
            for place, size in table.needs.items():
                sizes[place] = max(sizes.get(place, 0), size)
        for place, size in sizes.items():
            if place in present:
                if len(self._memory[place]) < size - 1:
                    raise ConfigError(
                        f"layout: a tag table needs {size} bytes of {place_name(place)}, whose layout has "
                        f"{len(self._memory[place])}; correct one of the two"
                    )
                continue
            area = self._memory[place] = bytearray(size)
            if place[0] is Area.BLOCK:
                self._server.add_block(place[1], area)
            else:
                self._server.add_area(AREAS[place[0]], area)
        for table in tables:
            table.fill(self._memory, present)

    def _step(self, time_s: float) -> None:
        with self._server.lock:
            if self._table is None:
                self._program.step(time_s, self._frame)
            elif not isinstance(self._program, Idle):
                self._table.load(self._frame, self._memory)
                before = bytes(self._frame)
                self._program.step(time_s, self._frame)
                self._table.store(before, self._frame, self._memory)
