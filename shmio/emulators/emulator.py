"""An emulated S7 controller: a cyclic program, and a server that gives clients access to its memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Final, Self

import msgspec
from snap7.server import CPUState
from snap7.type import SrvArea

from shmio.config.address import Address
from shmio.emulators.areas import Place, TableMemory, place_name
from shmio.emulators.cycle import Cycle
from shmio.emulators.device import Served
from shmio.emulators.programs import BUILT_IN, Idle, Program, UserCode, program
from shmio.emulators.s7 import S7Server, ServerOptions
from shmio.errors import ConfigError, SnapshotError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.s7.address import Area
from shmio.layout.values.codec import codec
from shmio.model.snapshot import decode_part

AREAS: Final[Mapping[Area, SrvArea]] = {
    Area.INPUT: SrvArea.PE,
    Area.OUTPUT: SrvArea.PA,
    Area.MARKER: SrvArea.MK,
    Area.TIMER: SrvArea.TM,
    Area.COUNTER: SrvArea.CT,
    Area.BLOCK: SrvArea.DB,
}
"""python-snap7's name of each memory area."""


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
            db_number: The block's number; None: the number in the layout.
            others: Blocks without a program, served under their own numbers, and tag tables.
            max_clients: Maximum number of clients at a time.
            options: Limits and faults of the server.
            code: Folder and parameters of the program if it is a class of the user.

        Raises:
            ConfigError: There is no such program, the layout does not suit it, a number is missing
                or used twice, or a block is too short for a tag table.

        """
        self._server = S7Server(listen, max_clients=max_clients, options=options)
        self._program_name, self._code, self._db_number = program_name, code, db_number
        self._contents = self._made([layout, *others])
        for (area, number), data in self._contents.memory.items():
            self._serve(area, number, data)
        self.cycle = Cycle(
            self._contents.program.period_ms / 1000,
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

    def change(self, served: Sequence[Served]) -> None:
        """Serve other blocks and tables from now on. Memory that is served before and after keeps its values.

        Raises:
            ConfigError: As for a new emulator; nothing was changed.

        """
        contents = self._made([one.layout for one in served])
        with self._server.lock:
            contents.adopt(self._contents)
            for area, number in self._contents.memory.keys() - contents.memory.keys():
                self._server.remove(AREAS[area], number)
            for (area, number), data in contents.memory.items():
                if (area, number) in self._contents.memory:
                    self._server.replace(AREAS[area], number, data)
                else:
                    self._serve(area, number, data)
            self._contents = contents

    def save(self) -> bytes:
        """Return the state of the memory and the program, for a snapshot.

        Raises:
            SnapshotError: The CPU is not in RUN, or the program cannot save its state.
            ModelError: The program's code failed.

        """
        if self._server.cpu_state != CPUState.RUN:
            raise SnapshotError("its CPU is not in RUN; start it first")
        with self._server.lock:
            contents = self._contents
            memory = [bytes(area) for area in contents.memory.values()]
            return msgspec.msgpack.encode((bytes(contents.frame), memory, contents.program.save()))

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it.

        Raises:
            SnapshotError: The state is damaged, or does not fit the controller.

        """
        if self._server.cpu_state != CPUState.RUN:
            raise SnapshotError("its CPU is not in RUN; start it first")
        frame, memory, program_state = decode_part(data, tuple[bytes, list[bytes], bytes])
        contents = self._contents
        areas = list(contents.memory.values())
        if len(frame) != len(contents.frame) or list(map(len, memory)) != list(map(len, areas)):
            raise SnapshotError("its memory has other areas")
        restore_program = contents.program.prepare_restore(program_state)

        def restore() -> None:
            with self._server.lock:
                restore_program()
                contents.frame[:] = frame
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

    def _made(self, layouts: Sequence[Layout]) -> _Contents:
        return _Contents(layouts, program(self._program_name, layouts[0], self._code), self._db_number)

    def _serve(self, area: Area, number: int, data: bytearray) -> None:
        if area is Area.BLOCK:
            self._server.add_block(number, data)
        else:
            self._server.add_area(AREAS[area], data)

    def _step(self, time_s: float) -> None:
        with self._server.lock:
            self._contents.step(time_s)


class _Contents:
    """The controller's memory, its program, and the registers by which the program sees the memory."""

    def __init__(self, layouts: Sequence[Layout], own: Program, db_number: int | None) -> None:
        """Create the memory with its initial values.

        Args:
            layouts: The data blocks and tag tables; the program runs on the first.
            own: The program.
            db_number: The number of the program's block; default: the layout's own.

        Raises:
            ConfigError: A number is missing or used twice, or a block is too short for a tag table.

        """
        self.program = own
        self.memory: dict[Place, bytearray] = {}
        self._blocks: dict[Place, Layout] = {}
        self._table = TableMemory(layouts[0]) if layouts[0].addressed else None
        self.frame = bytearray(layouts[0].size) if self._table else self._add_block(layouts[0], db_number)
        for other in layouts[1:]:
            if not other.addressed:
                self._add_block(other, None)
        others = [TableMemory(one) for one in layouts[1:] if one.addressed]
        self._tables = [self._table, *others] if self._table else others
        self._add_tables()

    def step(self, time_s: float) -> None:
        """Run a cycle of the program."""
        if self._table is None:
            self.program.step(time_s, self.frame)
        elif not isinstance(self.program, Idle):
            self._table.load(self.frame, self.memory)
            before = bytes(self.frame)
            self.program.step(time_s, self.frame)
            self._table.store(before, self.frame, self.memory)

    def adopt(self, other: _Contents) -> None:
        """Copy the values that other contents have for the same memory."""
        for place, area in self.memory.items():
            before = other.memory.get(place)
            if before is None:
                continue
            block, old = self._blocks.get(place), other._blocks.get(place)
            if block is None or old is None:
                size = min(len(area), len(before))
                area[:size] = before[:size]
                continue
            known = {(one.path, one.type, one.dims): one for one in old.registers}
            for one in block.registers:
                if (there := known.get((one.path, one.type, one.dims))) is not None:
                    with suppress(ValueError, ValueRangeError):  # a client may have stored bytes that are no value
                        value = codec(there, old.byte_order).decode(before)
                        codec(one, block.byte_order).encode_into(value, area)
        keys = frozenset(key for table in other._tables for key in table.keys)
        for table in self._tables:
            table.fill(self.memory, other.memory, keys)

    def _add_block(self, layout: Layout, number: int | None) -> bytearray:
        """Add a block with its initial values, under ``number`` or the block's own number."""
        number = layout.number if number is None else number
        if number is None:
            raise ConfigError(
                f"dbNumber: this key is needed, because the layout {layout.name!r} has no number in its name"
            )
        place = Area.BLOCK, number
        if place in self.memory:
            raise ConfigError(f"DB{number} is served already")
        self._blocks[place] = layout
        self.memory[place], _ = initial_frame(layout)
        return self.memory[place]

    def _add_tables(self) -> None:
        """Add the areas that tables need and that do not exist yet, and store the tables' initial values."""
        present = frozenset(self.memory)
        sizes: dict[Place, int] = {}
        for table in self._tables:
            for place, size in table.needs.items():
                sizes[place] = max(sizes.get(place, 0), size)
        for place, size in sizes.items():
            if place not in present:
                self.memory[place] = bytearray(size)
            elif len(self.memory[place]) < size - 1:
                raise ConfigError(
                    f"layout: a tag table needs {size} bytes of {place_name(place)}, whose layout has "
                    f"{len(self.memory[place])}; correct one of the two"
                )
        for table in self._tables:
            table.fill(self.memory, present)
