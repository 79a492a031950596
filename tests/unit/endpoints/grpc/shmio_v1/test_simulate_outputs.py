"""The outputs of a model, encoded into an image of its block."""

from __future__ import annotations

import asyncio

import pytest

from shmio.endpoints.grpc.shmio_v1.simulate import OutputEncoder
from shmio.endpoints.grpc.shmio_v1.tables import Selection
from shmio.endpoints.grpc.shmio_v1.write import MAX_VALUES
from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.messages import value_to_wire
from shmio.segment import BlockSpec, Segment
from shmio.wire import shmio_v1_pb2 as wire

ROWS = Layout("ROWS", None, 20_000, False, (Register("rows", "DINT", ((0, 4999),), 0, None, 20_000, 5000),))


def test_the_number_of_values_by_path_is_limited(instance: str) -> None:
    blocks = [BlockSpec("line", ROWS, 20_000_000, 500_000_000, 1 << 20)]
    with Segment.create(instance, blocks, []) as segment:
        try:
            fill = OutputEncoder(Selection(1, segment.blocks["line"], ROWS.registers))
            given = [wire.Assignment(path=f"rows/{at}", value=value_to_wire(at, "rows")) for at in range(MAX_VALUES)]
            image = bytearray(ROWS.size)
            asyncio.run(fill.decode_assignments(given, image))
            assert image[4 * 4095 : 4 * 4096] == (4095).to_bytes(4, "big")
            with pytest.raises(
                ValueRangeError, match=r"4097 values are given by path, at most 4096 are allowed; use slots"
            ):
                asyncio.run(fill.decode_assignments([*given, given[0]], image))
        finally:
            segment.unlink()
