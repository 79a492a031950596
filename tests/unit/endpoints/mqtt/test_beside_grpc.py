"""The gRPC and MQTT endpoints on one segment."""

from __future__ import annotations

import asyncio
import random
import struct
from collections.abc import Callable

from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto
from tests.unit.endpoints.harness import Endpoint, image, serve, value
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge, listening

BATCH = 20
"""Frames published before both clients have seen them; few enough that no endpoint skips one."""


def positions(count: int) -> list[float]:
    """Return REALs of all sizes, each different from the previous one, some repeated."""
    chosen = random.Random(1)
    some = [0.1, -0.0, 1e-30, 3.4e38, 16777216.0, *(chosen.uniform(-1000, 1000) for _ in range(20))]
    found = [0.0]
    while len(found) < count:
        (one,) = struct.unpack(">f", struct.pack(">f", chosen.choice(some)))
        if one != found[-1]:
            found.append(one)
    return found


def test_clients_of_both_endpoints_see_the_same_values_in_the_same_order(
    segment: Segment, make_broker: Callable[..., Mosquitto]
) -> None:
    broker = make_broker("allow_anonymous true", "max_inflight_messages 10000")
    given = positions(1 + 20 * BATCH)
    by_grpc: list[str] = []

    async def test(served: Endpoint) -> None:
        served.publish(image(position=given[0]))
        stream = served.subscribe("cell/axis/position")
        by_grpc.append(await value(stream))
        with listening(broker.address, f"{PREFIX}/cell/axis/position/out") as listener, bridge(segment, broker.address):
            await asyncio.to_thread(listener.message)
            for begin in range(1, len(given), BATCH):
                for position in given[begin : begin + BATCH]:
                    served.publish(image(position=position))
                for _ in range(BATCH):
                    by_grpc.append(await value(stream))
                    await asyncio.to_thread(listener.message)
            by_mqtt = listener.values("cell/axis/position/out")
        stream.cancel()
        assert by_mqtt == by_grpc
        assert [struct.pack(">f", float(text)) for text in by_mqtt] == [struct.pack(">f", one) for one in given]

    serve(segment, test)
