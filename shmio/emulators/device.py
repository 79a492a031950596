"""The interface of an emulated device to its process, and the layouts that it serves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

from shmio.emulators.cycle import Cycle
from shmio.layout.model import Layout


class Served(NamedTuple):
    """A layout that an emulator serves."""

    layout: Layout
    options: Mapping[str, Any] = MappingProxyType({})
    """The keys of the source that reads this layout, such as ``unit`` or ``nodes``."""


class Device(Protocol):
    """An emulated device."""

    @property
    def cycle(self) -> Cycle:
        """The cycle of the device's program."""

    def start(self) -> None:
        """Listen, and run the program. Raise EndpointError if the address is not available."""

    def save(self) -> bytes:
        """Return the state of the memory and the program, for a snapshot. Call this between two cycles.

        Raises:
            SnapshotError: The state cannot be saved.
            ModelError: The program's code failed.

        """

    def prepare_restore(self, data: bytes) -> Callable[[], None]:
        """Check a state, and return the function that restores it.

        Raises:
            SnapshotError: The state is damaged, or does not fit the device.
        """

    def change(self, served: Sequence[Served]) -> None:
        """Serve other layouts from now on, and keep the connections of clients. Call this between two cycles.

        Memory that the old and the new layouts share keeps its values. The program starts again, on
        the first layout.

        Raises:
            ConfigError: A layout does not suit the device or its program; nothing was changed.

        """

    def stop(self) -> None:
        """Stop listening, and stop the program; return when all threads have ended."""
