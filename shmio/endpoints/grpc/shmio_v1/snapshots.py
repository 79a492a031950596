"""The calls of shmio.v1 about snapshots: SaveSnapshot, RestoreSnapshot, ListSnapshots, DeleteSnapshot."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import grpc
import msgspec

from shmio.audit.trail import Attempt
from shmio.endpoints.grpc.server.error_status import Context, refuse
from shmio.endpoints.grpc.time.stepper import Stepper
from shmio.errors import ShmioError
from shmio.local.snapshot_file import delete_snapshot, file_of, list_snapshots
from shmio.local.snapshots import Snapshots, snapshot_folder
from shmio.local.time_control import Coordinator
from shmio.model.snapshot import SnapshotInfo
from shmio.segment import Segment
from shmio.wire import shmio_v1_pb2 as wire


class SnapshotCalls:
    """Serves the calls about snapshots."""

    def __init__(self, segment: Segment, stepper: Stepper) -> None:
        self._segment = segment
        self._stepper = stepper

    def handlers(self) -> dict[str, grpc.RpcMethodHandler[Any, Any]]:
        """Return the handlers of these calls, by name."""
        unary, snapshot = grpc.unary_unary_rpc_method_handler, wire.Snapshot.SerializeToString
        listed, deleted = wire.ListSnapshotsResponse.SerializeToString, wire.DeleteSnapshotResponse.SerializeToString
        return {
            "SaveSnapshot": unary(self.save, wire.SaveSnapshotRequest.FromString, snapshot),
            "RestoreSnapshot": unary(self.restore, wire.RestoreSnapshotRequest.FromString, snapshot),
            "ListSnapshots": unary(self.list, wire.ListSnapshotsRequest.FromString, listed),
            "DeleteSnapshot": unary(self.delete, wire.DeleteSnapshotRequest.FromString, deleted),
        }

    async def save(self, request: wire.SaveSnapshotRequest, context: Context) -> wire.Snapshot:
        """Save the state of the instance.

        Statuses:
            FAILED_PRECONDITION: The clock is in real time, another program controls time, the state
                of a process cannot be saved, or the file cannot be written.
        """
        return await self._do(
            "save snapshot",
            request.name,
            lambda snapshots: snapshots.save(request.name, partial=request.partial),
            context,
        )

    async def restore(self, request: wire.RestoreSnapshotRequest, context: Context) -> wire.Snapshot:
        """Restore a snapshot.

        Statuses:
            FAILED_PRECONDITION: The clock is in real time, another program controls time, there is
                no such snapshot, or it does not fit the instance.
        """
        return await self._do(
            "restore snapshot", request.name, lambda snapshots: snapshots.restore(request.name), context
        )

    async def list(self, _: wire.ListSnapshotsRequest, context: Context) -> wire.ListSnapshotsResponse:
        """List all snapshots.

        Statuses:
            FAILED_PRECONDITION: The folder of the snapshots cannot be read.
        """
        try:
            found = await asyncio.to_thread(lambda: list_snapshots(snapshot_folder(self._segment)))
        except ShmioError as error:
            await refuse(context, error)
        return wire.ListSnapshotsResponse(snapshots=map(_to_wire, found))

    async def delete(self, request: wire.DeleteSnapshotRequest, context: Context) -> wire.DeleteSnapshotResponse:
        """Delete a snapshot.

        Statuses:
            FAILED_PRECONDITION: There is no such snapshot, or it cannot be deleted.
        """
        try:
            with Attempt("delete snapshot", {"snapshot": request.name}) as attempt:
                await asyncio.to_thread(lambda: delete_snapshot(file_of(snapshot_folder(self._segment), request.name)))
                attempt.end("done")
        except ShmioError as error:
            await refuse(context, error)
        return wire.DeleteSnapshotResponse()

    async def _do(
        self, action: str, name: str, call: Callable[[Snapshots], SnapshotInfo], context: Context
    ) -> wire.Snapshot:
        def work(coordinator: Coordinator) -> SnapshotInfo:
            return call(Snapshots(self._segment, _Still(coordinator)))

        try:
            with Attempt(action, {"snapshot": name}) as attempt:
                found = await self._stepper.while_still(work)
                attempt.end("done")
        except ShmioError as error:
            await refuse(context, error)
        return _to_wire(found)


class _Still:
    """Time that this process controls already."""

    def __init__(self, coordinator: Coordinator) -> None:
        self._coordinator = coordinator

    def still(self) -> AbstractContextManager[Coordinator]:
        """Return the coordinator of this process."""
        return nullcontext(self._coordinator)


def _to_wire(snapshot: SnapshotInfo) -> wire.Snapshot:
    return wire.Snapshot(**msgspec.structs.asdict(snapshot))
