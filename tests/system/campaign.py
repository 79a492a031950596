"""A campaign with models in virtual time: it writes, injects, steps and collects all streams."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from contextlib import AsyncExitStack
from typing import Any, Final

import grpc
from google.protobuf.empty_pb2 import Empty
from google.protobuf.struct_pb2 import Value

import shmio
from shmio.wire import shmio_v1_pb2 as ours
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire import simserver_pb2 as sim
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub as V1Stub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as V2Stub
from shmio.wire.simserver_pb2_grpc import SimServerAPIStub

CONFIG = """
[instance]
name = "{instance}"
clock = "stepped"

[[source]]
name = "sim"
connector = "simulation"
model = "shmio.simulation.loopback:Loopback"
writable = ["**"]

[[source]]
name = "noise"
connector = "simulation"
model = "noisy:Noisy"
seed = 7
[source.connections]
drive = "sim/joints/Kuka.j1/R"

[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
writable = ["**"]

[[injection]]
name = "falsified"
target = "sim/joints/Kuka.j2/R"
operation = "noise"
amplitude = 0.25
when = "noise/measured > 10"
for_s = 0.3
seed = 11

[grpc]
listen = ["{grpc}"]
default_source = "sim"
"""
PANEL = """
[registers]
speed = { type = "REAL", initial = 0.5 }
lamps = { type = "ARRAY[0..7] OF BOOL" }
"""
NOISY = '''
"""Noise about a value that it is driven with."""

from shmio.simulation import Input, Model, Output


class Noisy(Model):
    drive = Input("LREAL")
    measured = Output("LREAL")
    glitches = Output("ARRAY[1..20] OF DINT")

    def step(self, time_s, dt_s):
        self.measured = self.drive + self.random.normal() * dt_s
        self.glitches = tuple(int(value) for value in self.random.integers(0, 4, 20))
'''
J1, J2, POSITION = "joints/Kuka.j1/R", "joints/Kuka.j2/R", "joints/R3200/Link1/R/position"
STEPS: Final = 80
PATIENCE_S: Final = 60
SLOW_S: Final = 0.004
"""Pause of a slow subscriber between two messages."""
_SMALL_WINDOW = [("grpc.http2.bdp_probe", 0), ("grpc.use_local_subchannel_pool", 1)]

Streams = dict[str, list[bytes]]


class Campaign:
    """The clients of one campaign. They start with a running instance that has not been stepped yet."""

    def __init__(self, instance: str, channel: grpc.aio.Channel, slow: grpc.aio.Channel, pause_s: float) -> None:
        self._instance = instance
        self._channel = channel
        self._slow = slow
        self._pause_s = pause_s
        self._old: Any = V1Stub(channel)  # type: ignore[no-untyped-call]
        self._new: Any = V2Stub(channel)  # type: ignore[no-untyped-call]
        self._time: Any = SimServerAPIStub(channel)  # type: ignore[no-untyped-call]
        self._readers: dict[str, asyncio.Task[list[bytes]]] = {}
        self._arrived = asyncio.Queue[str]()  # values published to J1 that the endpoint has received

    async def run(self) -> Streams:
        """Run the campaign; return the messages of each stream."""
        await self._subscribe()
        outgoing: Any = self._old.Publish(timeout=PATIENCE_S)
        with shmio.attach(self._instance, writable=True) as self._local:
            for number in range(1, STEPS + 1):
                await self._act(number)
                for part in range(number % 4 + 1):
                    value = f"{number - (number % 4 - part) / 4}"
                    await outgoing.write(_published(f"SIM://{J1}/in", value))
                async with asyncio.timeout(PATIENCE_S):  # gRPC does not order the value and the call of the step
                    while await self._arrived.get() != value:
                        pass
                await self._step(number)
        await outgoing.done_writing()
        await outgoing
        async with asyncio.timeout(PATIENCE_S):
            streams = {name: await reader for name, reader in self._readers.items()}
        return streams | {"shmio.v1": [update for message in streams["shmio.v1"] for update in _updates(message)]}

    # ---- listening -------------------------------------------------------------------------------------------------

    async def _subscribe(self) -> None:
        glitches = [f"noise/glitches/{index}" for index in range(1, 21)]
        await self._subscribe_new(
            "one", f"SIM://{J1}/out", "noise/measured", "SIMLOG://step", f"SIM://{J1}/in", "panel/speed"
        )
        await self._subscribe_new(
            "two", "SIMLOG://step", *glitches, J2, J1, f"/sim/{J1}", "panel/lamps", f"{POSITION}/in"
        )
        await self._subscribe_new("slow", "noise/glitches", "/noise/glitches", *glitches, "SIMLOG://step")
        await self._subscribe_old(f"{J1}/out", lambda message: message.value == f"{STEPS}.0")
        await self._subscribe_old(f"{J1}/in", self._arrive)
        await self._subscribe_old("noise/measured", lambda message: message.timeStamp.seq == STEPS)
        await self._subscribe_old("/model/clock", lambda message: message.timeStamp.seq == STEPS)
        over = sum(map(_step_ms, range(1, STEPS + 1)))
        await self._follow(
            "status", self._channel, "/com.ttsnetwork.simulator3.SimServerAPI/subscribe", Empty(),
            lambda data: sim.SimStatus.FromString(data).clock == over,
        )  # fmt: skip

        await self._follow(
            "shmio.v1", self._channel, "/shmio.v1.Shmio/Subscribe",
            ours.SubscribeRequest(patterns=["sim", "noise", "panel", f"sim/{J2}/in"]),
            lambda data: ours.SubscribeResponse.FromString(data).step.number == STEPS,
        )  # fmt: skip

    async def _subscribe_new(self, uuid: str, *paths: str) -> None:
        def over(data: bytes) -> bool:
            message = v2.SimlogMessage.FromString(data)
            return message.header.path == "SIMLOG://step" and message.value.number_value == STEPS

        channel = self._slow if uuid == "slow" else self._channel
        request = v2.Subscriber(name=uuid, uuid=uuid)
        await self._follow(f"v2 {uuid}", channel, "/simlog.server.SimlogAPI/CreateSubscriber", request, over)
        for path in paths:
            await self._new.Subscribe(v2.SubscriptionRequest(path=path, subscriberUUID=uuid), timeout=PATIENCE_S)

    async def _subscribe_old(self, path: str, over: Callable[[v1.ROSMessage], bool]) -> None:
        await self._follow(
            f"v1 {path}", self._channel, "/simulation.server.SimlogAPI/Subscribe", v1.TopicDescriptor(path=path),
            lambda data: over(v1.ROSMessage.FromString(data)),
        )  # fmt: skip

    def _arrive(self, message: v1.ROSMessage) -> bool:
        """Note a published value; return whether it is the last one."""
        self._arrived.put_nowait(message.value)
        return message.value == f"{STEPS}.0"

    async def _follow(
        self, name: str, channel: grpc.aio.Channel, method: str, request: Any, over: Callable[[bytes], bool]
    ) -> None:
        """Read a stream's raw messages in a task, up to the last one."""
        stream: Any = channel.unary_stream(method)(request.SerializeToString(), timeout=PATIENCE_S)
        await stream.initial_metadata()

        async def read() -> list[bytes]:
            messages: list[bytes] = []
            while not messages or not over(messages[-1]):
                messages.append(await stream.read())
                if channel is self._slow:
                    await asyncio.sleep(self._pause_s)
            stream.cancel()
            return messages

        self._readers[name] = asyncio.create_task(read())

    # ---- acting ----------------------------------------------------------------------------------------------------

    async def _act(self, number: int) -> None:
        """Write and inject before a step, and wait for each acknowledgement."""
        if number % 2:
            await self._write(f"SIM://{J2}/in", number_value=1 / number)
        if number % 3 == 0:
            await self._write("panel/speed", number_value=number)
            await self._write("panel/lamps", string_value=json.dumps([number >> bit & 1 for bit in range(8)]))
        local = self._local
        if number == 20:
            self._shadow = await asyncio.to_thread(local.inject, f"sim/{J1}", priority=1)
        if 20 <= number < 40 and number % 4 == 0:
            await asyncio.to_thread(self._shadow.set, {f"sim/{J1}": -number})
        if number == 40:
            await asyncio.to_thread(self._shadow.lift)
        if number == 30:
            await asyncio.to_thread(local.write, {f"sim/{POSITION}": 30.5})

    async def _write(self, path: str, **value: Any) -> None:
        message = v2.SimlogMessage(value=Value(**value))
        await self._new.Write(v2.PubRequest(topic=path, data=message), timeout=PATIENCE_S)

    async def _step(self, number: int) -> None:
        if number == 1:
            await self._old.setStepSize(v1.StepSizeRequest(step=20), timeout=PATIENCE_S)
        if number == 50:
            await asyncio.to_thread(self._step_here)
        elif _step_ms(number) == 50:
            await self._time.step(sim.StepRequest(deltaTime=50), timeout=PATIENCE_S)
        else:
            assert (await self._old.step(v1.StepRequest(), timeout=PATIENCE_S)).code == 0

    def _step_here(self) -> None:
        """Step as another program on the host, after the endpoint has released the clock."""
        with shmio.attach(self._instance, writable=True) as program:
            program.step()


def _published(path: str, value: str) -> v1.PubRequest:
    return v1.PubRequest(topic=v1.TopicDescriptor(path=path), data=v1.ROSMessage(type="double", value=value))


def _updates(message: bytes) -> list[bytes]:
    """Return the updates of a message, without the fields that differ between processes.

    A message has all updates that were due when it was sent.
    """
    updates = ours.SubscribeResponse.FromString(message).updates
    for update in updates:
        for name in ("table", "frame", "incarnation"):
            update.ClearField(name)
    return [update.SerializeToString(deterministic=True) for update in updates]


def _step_ms(number: int) -> int:
    return 50 if number % 5 == 4 else 20


async def run(instance: str, address: str, *, pause_s: float = 0.0) -> Streams:
    """Run the campaign; return the messages of each stream.

    One subscriber pauses for ``pause_s`` after each message.
    """
    async with AsyncExitStack() as stack:
        channel = await stack.enter_async_context(grpc.aio.insecure_channel(address))
        slow = await stack.enter_async_context(grpc.aio.insecure_channel(address, options=_SMALL_WINDOW))
        return await Campaign(instance, channel, slow, pause_s).run()
