"""The state of an emulated device in a snapshot."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from shmio.emulators.device import Device
from shmio.emulators.stepping import InstanceTime
from shmio.errors import SnapshotError
from shmio.model.snapshot import decode_part


class DeviceState(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    """The state of a device that follows the instance's clock.

    ``place`` is :attr:`InstanceTime.place`, and ``position`` is :attr:`Cycle.position`.
    """

    kind: str
    program: str
    place: tuple[int, int]
    position: tuple[int, int]
    device: bytes


class DeviceKeeper:
    """Saves and restores the state of a device. Use it in the thread that runs the scans of steps."""

    def __init__(
        self, device: Device, time: InstanceTime, kind: str, program: str, disturbed: Callable[[], bool]
    ) -> None:
        """Prepare to save and restore.

        Args:
            device: The device.
            time: Lets the device follow the instance's clock.
            kind: The kind of the emulator.
            program: The program's name.
            disturbed: Returns whether a command disturbs the device's answers.

        """
        self._device, self._time, self._kind, self._program, self._disturbed = device, time, kind, program, disturbed

    def save(self, name: str) -> bytes:  # noqa: ARG002
        """Return the state of the device.

        Raises:
            SnapshotError: The state cannot be saved.
            ModelError: The program's code failed.

        """
        if self._disturbed():
            raise SnapshotError(
                "a command disturbs the emulator's answers; end that first with shmio-supervisor emulator NAME ok"
            )
        cycle = self._device.cycle
        with cycle.held():
            state = DeviceState(self._kind, self._program, self._time.place, cycle.position, self._device.save())
        return msgspec.msgpack.encode(state)

    def check(self, data: bytes) -> None:
        """Check whether a state can be restored, without changing the device.

        Raises:
            SnapshotError: The state is damaged, or does not fit the device.

        """
        self._prepare(data)

    def restore(self, data: bytes, name: str) -> None:  # noqa: ARG002
        """Restore a state that :meth:`save` has returned.

        Raises:
            SnapshotError: The state is damaged, or does not fit the device.
            ModelError: The program's code failed.

        """
        state, restore = self._prepare(data)
        with self._device.cycle.held():
            restore()
            self._device.cycle.position = state.position
        self._time.jump(*state.place)

    def _prepare(self, data: bytes) -> tuple[DeviceState, Callable[[], None]]:
        state = decode_part(data, DeviceState)
        if (state.kind, state.program) != (self._kind, self._program):
            raise SnapshotError(
                f"the snapshot is of an emulator of kind {state.kind} with program {state.program}, but this one is "
                f"of kind {self._kind} with program {self._program}"
            )
        if min(*state.place, *state.position) < 0:
            raise SnapshotError("its state is damaged")
        return state, self._device.prepare_restore(state.device)
