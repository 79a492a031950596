"""Makes an emulated device misbehave on command, so that you can rehearse how its clients react."""

from __future__ import annotations

import selectors
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Final

from shmio.audit import trail
from shmio.audit.trail import Acting
from shmio.config.address import Address
from shmio.control import MAX_PATH_BYTES, Answer, ControlServer, Disturb, Peer, emulator_socket_path
from shmio.emulators.proxy import FaultProxy, tpkt
from shmio.errors import ControlError
from shmio.logs import fields
from shmio.worker import Worker

_LENGTHS: Final[Mapping[str, tuple[int, Callable[[bytes | bytearray], int]]]] = {
    "s7": (4, tpkt),
    "modbus": (6, lambda data: 6 + int.from_bytes(data[4:6], "big") if len(data) >= 6 else 0),
}
"""For each kind: offset after the length field of an answer, and a function that returns the answer's whole length."""


class FaultControl:
    """A proxy in front of an emulator's server, and the control socket that receives commands for its faults.

    Use it from one thread.
    """

    def __init__(
        self, worker: Worker, selector: selectors.BaseSelector, kind: str, server: Address, listen: Address
    ) -> None:
        """Listen for clients and for commands.

        Args:
            worker: The emulator's process.
            selector: The process's selector; the data of each key is the function to call.
            kind: The emulator's kind, one of ``kinds.FAULTY``.
            server: Where the emulator's server listens.
            listen: Where clients connect.

        Raises:
            EndpointError: ``listen`` is not available.
            ControlError: The control socket cannot be created.

        """
        self._head, framing = _LENGTHS[kind]
        self._worker = worker
        self._disturbs = False
        path = emulator_socket_path(worker.segment.header.control, worker.name)
        if len(path.encode()) > MAX_PATH_BYTES:
            raise ControlError(
                f"faults: the control socket {path} has a path of more than {MAX_PATH_BYTES} bytes; give the instance "
                "or the emulator a shorter name, or leave out faults"
            )
        with ExitStack() as cleanup:
            self._proxy = cleanup.enter_context(FaultProxy(server, listen=listen, framing=framing))
            self._control = ControlServer(path, selector, self._handle, self._deny, Disturb)
            cleanup.callback(self._control.close)
            self._cleanup = cleanup.pop_all()

    @property
    def disturbs(self) -> bool:
        """True while a command disturbs the answers."""
        return self._disturbs

    def expire(self) -> None:
        """Disconnect clients of the control socket that have not sent a command in time."""
        self._control.expire()

    def close(self) -> None:
        """Close all connections, and remove the control socket."""
        self._cleanup.close()

    def _handle(self, request: Disturb, answer: Answer) -> None:
        what = {"process": self._worker.name, "answers": request.answers}
        if request.answers == "delay":
            what["delay_ms"] = f"{request.delay_ms:g}"
        trail.record("disturb", what, "done", who=self._acting(answer.peer))
        self._disturb(request)
        note = "" if request.answers == "ok" else f"disturbed on command: {request.answers}"
        self._worker.report(note=f"{note} {request.delay_ms:g} ms" if request.answers == "delay" else note)
        self._worker.log.info("a client changed how the emulator answers: %s", request.answers, extra=fields(**what))
        answer.ok()

    def _disturb(self, request: Disturb) -> None:
        proxy = self._proxy
        self._disturbs = request.answers != "ok"
        proxy.pass_all()
        proxy.delay(0.0, request.delay_ms / 1000 if request.answers == "delay" else 0.0)
        if request.answers == "corrupt":
            proxy.edit(self._corrupted)
        elif request.answers == "hang":
            proxy.freeze()
        elif request.answers == "refuse":
            proxy.refuse()

    def _corrupted(self, frame: bytes) -> bytes:
        """Invert an answer after its length field, so that the client still receives the whole answer."""
        return frame[: self._head] + bytes(byte ^ 0xFF for byte in frame[self._head :])

    def _deny(self, peer: Peer) -> None:
        reason = "only the emulator's own user and root may control it"
        trail.record("disturb", {"process": self._worker.name}, "denied", reason, who=self._acting(peer))

    def _acting(self, peer: Peer) -> Acting:
        origin = f"pid {peer.pid} {trail.program_of(peer.pid)}".rstrip()
        return Acting(trail.uid_actor(peer.uid, origin), self._worker.name)
