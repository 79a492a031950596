"""The registers of a recording as numpy arrays, or as tables of pyarrow, pandas and polars."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from shmio.errors import RecordingError
from shmio.layout.model import ByteOrder, Layout, Register
from shmio.layout.values.frame_codec import FrameCodec
from shmio.libraries import ANALYSIS, library
from shmio.model.statuses import status_registers
from shmio.recording.reading.batch import HEAD, Batch
from shmio.recording.reading.part import DumpBlock

if TYPE_CHECKING:
    import pandas
    import polars
    import pyarrow

Array = npt.NDArray[Any]

FIELDS: Final = ("number", "cycle", "source_ns", "quality", "provenance")
"""The fields of a frame's header that become columns."""
OF_FRAMES: Final = frozenset({"time", "source_time", "number", "cycle", "quality", "provenance"})
"""The names of table columns that do not belong to registers."""
DECODED_BYTES: Final = 1 << 20
"""Approximate number of bytes of frames to decode at once."""


@dataclass(frozen=True)
class Columns(Mapping[str, Array]):
    """The values of registers of one source in n frames, as a mapping.

    The keys are the paths without the source. The values are arrays of shape (n, …). If the source
    gave its registers statuses, the key ``PATH#status`` has the OPC UA status codes of a register,
    and ``PATH#source_ns`` has the register's times (UTC, ns since 1970; 0 if the source time of the
    frame applies).

    Attributes:
        source: Name of the source.
        registers: The registers.
        time_ns: Log times, UTC in ns, shape (n,).
        number: Numbers of the frames, shape (n,).
        cycle: Cycles of the source's schedule, shape (n,).
        source_ns: Time stamps of the source, UTC in ns, shape (n,). In frames before the source had
            any value, the time stamp and all values are 0.
        quality: 0 bad, 1 uncertain, 2 good; shape (n,).
        provenance: 0 live, 1 simulated, 2 replayed, 3 injected; shape (n,).
        values_by_path: The values, by path without the source.
    """

    source: str
    registers: tuple[Register, ...]
    time_ns: npt.NDArray[np.int64]
    number: npt.NDArray[np.uint64]
    cycle: npt.NDArray[np.uint64]
    source_ns: npt.NDArray[np.int64]
    quality: npt.NDArray[np.uint8]
    provenance: npt.NDArray[np.uint8]
    values_by_path: Mapping[str, Array]

    def __getitem__(self, path: str) -> Array:
        """Return the values of the register with this path (without the source)."""
        return self.values_by_path[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_by_path)

    def __len__(self) -> int:
        return len(self.values_by_path)

    def to_arrow(self) -> pyarrow.Table:
        """Return a pyarrow table with a row for each frame.

        The columns are the time (UTC in ns), source time, number, cycle, quality, provenance, and
        the registers, with native types: arrays are lists of fixed size, POINTER and ANY are bytes.
        A value is null if the bytes are not valid for the type, or if the source had no value yet.
        If the path of a register equals the name of another column, the register's column is named
        ``source/path``.

        Raises:
            MissingLibraryError: pyarrow is not installed.
        """
        arrow = library("pyarrow", ANALYSIS)
        unknown = self.source_ns == 0
        time = arrow.timestamp("ns", "UTC")
        fields = {
            "time": arrow.array(self.time_ns).cast(time),
            "source_time": arrow.array(self.source_ns, mask=unknown).cast(time),
            "number": arrow.array(self.number),
            "cycle": arrow.array(self.cycle),
            "quality": _categories(arrow, self.quality, ("bad", "uncertain", "good")),
            "provenance": _categories(arrow, self.provenance, ("live", "simulated", "replayed", "injected")),
        }
        for path, values in self.items():
            fields[heading(self.source, path)] = _lists(arrow, values, unknown)
        return arrow.Table.from_arrays(list(fields.values()), names=list(fields))

    def to_pandas(self) -> pandas.DataFrame:
        """Return a pandas data frame with a row for each frame.

        The index is the time (UTC). The columns are number, cycle, quality, and one column for each
        register or array element.

        Raises:
            MissingLibraryError: pandas is not installed.
        """
        pandas = library("pandas", ANALYSIS)
        data = {"number": self.number, "cycle": self.cycle, "quality": self.quality, **self._flat()}
        return pandas.DataFrame(data, index=pandas.to_datetime(self.time_ns, utc=True).rename("time"))

    def to_polars(self) -> polars.DataFrame:
        """Return a polars data frame with the columns of :meth:`to_pandas` after a column ``time``.

        Raises:
            MissingLibraryError: polars is not installed.
        """
        polars = library("polars", ANALYSIS)
        time = polars.Series("time", self.time_ns).cast(polars.Datetime("ns", "UTC"))
        data = {"number": self.number, "cycle": self.cycle, "quality": self.quality, **self._flat()}
        return polars.DataFrame([time, *(polars.Series(name, values) for name, values in data.items())])

    def _flat(self) -> dict[str, Array]:
        return {
            heading(self.source, name): values
            for register in self.registers
            for name, values in flat(register, self[register.path])
        }


def heading(source: str, path: str, taken: Collection[str] = OF_FRAMES) -> str:
    """Return the name of a register's column: its path, or ``source/path`` if ``taken`` contains the path."""
    return f"{source}/{path}" if path in taken else path


def flat(register: Register, values: Array) -> Iterator[tuple[str, Array]]:
    """Yield (path, values) for the column of a register or, for an array, of each element.

    Values of POINTER and ANY become hexadecimal digits.
    """
    if values.dtype.kind == "V":
        texts = [bytes(value).hex() for value in values.reshape(-1)]
        values = np.array(texts, f"U{2 * values.dtype.itemsize}").reshape(values.shape)
    if not register.dims:
        yield register.path, values
        return
    rows = values.reshape(len(values), register.count)
    for flat_index, place in enumerate(product(*(range(length) for length in register.shape))):
        index = "/".join(str(low + at) for at, (low, _) in zip(place, register.dims, strict=True))
        yield f"{register.path}/{index}", rows[:, flat_index]


class Collector:
    """Collects batches of frames, and converts them to columns."""

    def __init__(self, source: str) -> None:
        self._source = source
        self._registers: tuple[Register, ...] = ()
        self._codec: FrameCodec | None = None
        self._waiting: list[Batch] = []
        self._waiting_bytes = 0
        self._times: list[npt.NDArray[np.int64]] = []
        self._heads: list[Array] = []
        self._decoded: list[Array] = []

    @property
    def begun(self) -> bool:
        """True if :meth:`begin` has set the registers."""
        return self._codec is not None

    def begin(self, block: DumpBlock, registers: Sequence[Register]) -> None:
        """Set the registers of the block from which the next frames come.

        Raises:
            RecordingError: The types of the registers differ from those in the previous block.
        """
        registers = (*registers, *status_registers(block.layout, registers))
        codec = record_codec(registers, block.layout.size, block.layout.byte_order)
        if self._codec is codec:
            return
        if self._codec is not None and self._codec.dtype != codec.dtype:
            raise RecordingError(
                f"{self._source}: a reload changed these registers within the range; choose a range before or after it"
            )
        self._flush()
        self._codec, self._registers = codec, registers

    def add(self, block: DumpBlock, registers: Sequence[Register], batch: Batch) -> None:
        """Add frames of a block.

        Raises:
            RecordingError: The types of the registers differ from those in the previous block.
        """
        self.begin(block, registers)
        self._waiting.append(batch)
        self._waiting_bytes += batch.records.nbytes
        if self._waiting_bytes >= DECODED_BYTES:
            self._flush()

    def _flush(self) -> None:
        if self._waiting and self._codec is not None:
            records = np.concatenate([batch.records for batch in self._waiting])
            self._times += [batch.time_ns for batch in self._waiting]
            head = records[:, : HEAD.itemsize].view(HEAD)[:, 0]
            kept = np.empty(len(head), [(name, HEAD[name]) for name in FIELDS])
            for name in FIELDS:
                kept[name] = head[name]
            self._heads.append(kept)
            self._decoded.append(self._codec.decode(records))
        self._waiting, self._waiting_bytes = [], 0

    @property
    def bytes(self) -> int:
        """Approximate number of bytes of the frames that were added since the last call of :meth:`columns`."""
        return self._waiting_bytes + sum(some.nbytes for some in self._decoded)

    def columns(self) -> Columns:
        """Return the columns of the frames that were added since the last call."""
        self._flush()
        assert self._codec is not None  # noqa: S101  begin() was called before
        decoded = np.concatenate([np.empty(0, self._codec.dtype), *self._decoded])
        heads = np.concatenate([np.empty(0, [(name, HEAD[name]) for name in FIELDS]), *self._heads])
        header = {name: np.ascontiguousarray(heads[name]) for name in FIELDS}
        values = {register.path: np.ascontiguousarray(decoded[register.path]) for register in self._registers}
        time_ns = np.concatenate([np.empty(0, np.int64), *self._times])
        self._times, self._heads, self._decoded = [], [], []
        return Columns(self._source, self._registers, time_ns, **header, values_by_path=values)


@lru_cache(maxsize=64)
def record_codec(registers: tuple[Register, ...], size: int, byte_order: ByteOrder) -> FrameCodec:
    """Return a codec that decodes registers from the records of a batch.

    Each record is a header, followed by an image of ``size`` bytes.
    """
    shifted = tuple(msgspec.structs.replace(register, offset=register.offset + HEAD.itemsize) for register in registers)
    return FrameCodec(Layout("", None, HEAD.itemsize + size, False, shifted, byte_order))


def _categories(arrow: Any, codes: npt.NDArray[np.uint8], names: tuple[str, ...]) -> Any:
    known = np.where(codes < len(names), codes, 0).astype(np.int8)  # an unknown code gets the first name
    return arrow.DictionaryArray.from_arrays(arrow.array(known), arrow.array(names))


def _lists(arrow: Any, values: npt.NDArray[Any], unknown: npt.NDArray[np.bool_]) -> Any:
    """Convert values of shape (n, …) to a pyarrow array of n values or nested lists."""
    mask = np.repeat(unknown, values[0].size) if len(values) and values.ndim > 1 else unknown
    plain = np.ascontiguousarray(values).reshape(-1)
    if plain.dtype.kind in "mM":
        mask = mask | np.isnat(plain)
    if plain.dtype.kind == "V":
        size = plain.dtype.itemsize
        hidden = [None if hide else bytes(value) for value, hide in zip(plain, mask, strict=True)]
        found = arrow.array(hidden, arrow.binary(size))
    elif plain.dtype.kind == "U":
        found = arrow.array(plain.tolist(), arrow.string(), mask=mask)
    else:
        found = arrow.array(plain, mask=mask)
    for length in reversed(values.shape[1:]):
        found = arrow.FixedSizeListArray.from_arrays(found, length)
    return found
