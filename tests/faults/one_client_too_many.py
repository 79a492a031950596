"""Loads each endpoint with one client of the role ``read``: ``python -m tests.faults.one_client_too_many --for 60``.

The client sends the heaviest load that the endpoint allows. Another client, with a token of its own, makes one
request after the other on one connection: beside a busy processor, then beside the load. The table has the delays
of its requests, how often its connection failed, how much of its data was lost, and how often the supervisor
restarted the process.

The load yields to the other processes (``NICE``), as if it ran on another host. So that the reference has the same
conditions, loops that yield as much keep the processors busy meanwhile. The table has
the processor time that the load and the endpoint's process have used: if the endpoint used little, the load was not
heavy, because the host was busy or because the endpoint gave it no more.

To add an endpoint, add a row to ``ENDPOINTS``: the name of its process, a function that loads it until its
process is terminated, and a context manager that connects the other client, and yields a function that makes a
request. The function raises an exception if the connection, or data, is lost.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import http.client
import json
import math
import os
import secrets
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import grpc
from paho.mqtt.client import Client as MqttClient
from paho.mqtt.client import MQTTv5
from paho.mqtt.enums import CallbackAPIVersion
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from shmio import client, control
from shmio.config import Address
from shmio.errors import ShmioError
from shmio.testing.cell import CONFIG, Cell
from shmio.testing.ports import reserved_port
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v1_pb2_grpc, simlog_v2_pb2_grpc
from shmio.wire import simlog_v2_pb2 as v2

ROOT: Final = Path(__file__).parents[2]
LOAD, OTHER = "load-0123456789abcdefghijk", "other-0123456789abcdefghij"
"""The tokens of the two clients."""
CALL_S: Final = 60.0
REGISTER: Final = "cell/Robot_800/Axs1_Pos"
WIDE: Final = ("cell/Inputs", "cell/Outputs")
"""The largest registers."""
NICE: Final = 10
"""What the load adds to its nice value, nice(2)."""
PAUSE_S: Final = 0.02
"""Time between two requests of the other client: one in each cycle of the source."""
MORE: Final = """
[[grpc.token]]
name = "load"
roles = ["read"]
sha256 = "{load}"

[[grpc.token]]
name = "other"
roles = ["read"]
sha256 = "{other}"

[web]
listen = "{web}"

[metrics]
listen = "{metrics}"

[mqtt]
listen = "{mqtt}"

[opcua]
listen = "{opcua}"
anonymous = ["read"]

[fabric]
server = "embedded"
listen = "{fabric}"
cell = "plant1.line3.a50"
"""
FABRIC_CELL: Final = "plant1.line3.a50"


@dataclass(frozen=True)
class Place:
    """Where the endpoints are."""

    web: str
    metrics: str
    grpc: str
    mqtt: str
    opcua: str
    fabric: str
    control: str
    instance: str


@dataclass
class Delays:
    """The delays of a client's requests in ms, and what it has lost."""

    delays_ms: list[float] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        if not self.delays_ms:
            return "-"
        worst = sorted(self.delays_ms)[int(0.95 * (len(self.delays_ms) - 1))]
        return f"{statistics.median(self.delays_ms):.2f} / {worst:.2f} / {max(self.delays_ms):.2f}"


class Endpoint(NamedTuple):
    """A row of the table."""

    process: str
    load: Callable[[Place], None]
    other: Callable[[Place], AbstractContextManager[Callable[[], object]]]


@dataclass
class Result:
    """What the load did to the other client."""

    before: Delays
    during: Delays
    restarts: int
    load: float
    """Processors that the load has used."""
    endpoint: float
    """Processors that the endpoint's process has used beside the load."""

    @property
    def times(self) -> str:
        """How many times longer the delays are beside the load."""
        medians = [statistics.median(one.delays_ms) for one in (self.before, self.during) if one.delays_ms]
        return f"{medians[1] / medians[0]:.1f} times" if len(medians) == 2 else "-"

    @property
    def faults(self) -> list[str]:
        """What must not happen, whatever the host's speed."""
        found = [f"lost: {what}" for what in (*self.before.lost, *self.during.lost)]
        if self.restarts:
            found.append(f"{self.restarts} restarts")
        if not self.during.delays_ms:
            found.append("no request was answered beside the load")
        return found


class LostError(Exception):
    """The other client has lost data."""


def in_threads(count: int, work: Callable[[int], object]) -> None:
    """Do work again and again, in a number of threads. A refusal is an answer."""

    def run(number: int) -> None:
        while True:
            with suppress(OSError, ShmioError, grpc.RpcError, http.client.HTTPException, WebSocketException):
                work(number)

    threads = [threading.Thread(target=run, args=(number,), daemon=True) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


# -- web -----------------------------------------------------------------------------------------------------------


def signed_in(place: Place, token: str) -> ClientConnection:
    connection = http.client.HTTPConnection(place.web, timeout=CALL_S)
    connection.request("POST", "/session", json.dumps({"token": token}))
    answer = connection.getresponse()
    cookie = answer.headers["set-cookie"].partition(";")[0]
    connection.close()
    return connect(f"ws://{place.web}/socket", additional_headers={"Cookie": cookie}, open_timeout=CALL_S)


def call(name: str, **given: Any) -> str:
    return json.dumps({"id": 7, "call": name, "with": given})


def load_page(place: Place) -> None:
    """Open as many pages as a server has, follow all on each, and keep as many calls in progress as a page may."""
    every = {"first": 0, "count": 200, "expanded": ["cell", *WIDE], "filter": ""}
    calls = [
        call("registers.rows", **every), call("registers.rows", **every | {"filter": "a"}),
        call("log.lines", filter="", process="", count=200), call("injections.condition", when=f"{REGISTER} > 0"),
        call("time.state"), call("recordings.files"), call("recordings.replays"), call("configuration.follow"),
    ]  # fmt: skip

    def page(_: int) -> None:
        with signed_in(place, LOAD) as browser:
            paths = [f"{wide}/{number}" for wide in WIDE for number in range(60)]
            for name in ("overview", "injections", "cells"):
                browser.send(call(f"{name}.follow"))
            browser.send(call("plots.follow", source="cell", paths=paths))
            for _ in range(2):
                for text in calls:
                    browser.send(text)
            while True:
                message = browser.recv(CALL_S)
                if isinstance(message, str) and message.startswith('{"id"'):
                    browser.send(calls[secrets.randbelow(len(calls))])

    in_threads(64, page)


@contextmanager
def other_page(place: Place) -> Iterator[Callable[[], object]]:
    with signed_in(place, OTHER) as browser:

        def ask() -> None:
            browser.send(call("registers.rows", first=0, count=20))
            while json.loads(browser.recv(CALL_S)).get("id") != 7:
                pass

        yield ask


@contextmanager
def scraper(place: Place, token: str) -> Iterator[Callable[[], object]]:
    connection = http.client.HTTPConnection(place.metrics, timeout=CALL_S)

    def ask() -> None:
        connection.request("GET", "/metrics", headers={"Authorization": f"Bearer {token}"})
        answer = connection.getresponse()
        if answer.status != 200 or b"shmio_source_frames_total" not in answer.read():
            raise LostError(f"status {answer.status}")

    yield ask
    connection.close()


def load_metrics(place: Place) -> None:
    def ask(_: int) -> None:
        with scraper(place, LOAD) as one:
            while True:
                one()

    in_threads(32, ask)


def other_scraper(place: Place) -> AbstractContextManager[Callable[[], object]]:
    return scraper(place, OTHER)


# -- gRPC ----------------------------------------------------------------------------------------------------------


def bearer(token: str) -> list[tuple[str, str]]:
    return [("authorization", f"Bearer {token}")]


def channel_of(place: Place) -> grpc.Channel:
    return grpc.insecure_channel(place.grpc, [("grpc.use_local_subchannel_pool", 1)])


def load_v1(place: Place) -> None:
    """Keep many streams, half of them of large registers, and ask beside them as fast as the endpoint answers."""

    def work(number: int) -> None:
        with channel_of(place) as channel:
            stub: Any = simlog_v1_pb2_grpc.SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            topics = [v1.TopicDescriptor(path=WIDE[number % 2] if number % 2 else f"{WIDE[1]}/{n}") for n in range(16)]
            streams = [stub.Subscribe(topic, metadata=bearer(LOAD)) for topic in topics]
            while streams:
                for _ in range(100):
                    stub.GetTopic(topics[0], timeout=CALL_S, metadata=bearer(LOAD))
                next(streams[secrets.randbelow(len(streams))])

    in_threads(16, work)


@contextmanager
def other_v1(place: Place) -> Iterator[Callable[[], object]]:
    with channel_of(place) as channel:
        stub: Any = simlog_v1_pb2_grpc.SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        yield lambda: stub.GetTopic(v1.TopicDescriptor(path=REGISTER), timeout=CALL_S, metadata=bearer(OTHER))


def load_v2(place: Place) -> None:
    """Read all large registers, and subscribe to all their elements."""

    def work(number: int) -> None:
        with channel_of(place) as channel:
            stub: Any = simlog_v2_pb2_grpc.SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            name = f"load-{number}-{secrets.token_hex(4)}"
            stream = stub.CreateSubscriber(v2.Subscriber(name=name, uuid=name), metadata=bearer(LOAD))
            for at in range(1000):
                path = f"{WIDE[at % 2]}/{at // 2}"
                request = v2.SubscriptionRequest(path=path, subscriberUUID=name)
                stub.Subscribe(request, timeout=CALL_S, metadata=bearer(LOAD))
            while True:
                stub.Read(v2.ReadRequest(path=[*WIDE] * 10), timeout=CALL_S, metadata=bearer(LOAD))
                next(stream)

    in_threads(16, work)


@contextmanager
def other_v2(place: Place) -> Iterator[Callable[[], object]]:
    with channel_of(place) as channel:
        stub: Any = simlog_v2_pb2_grpc.SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        yield lambda: stub.Read(v2.ReadRequest(path=[REGISTER]), timeout=CALL_S, metadata=bearer(OTHER))


def load_shmio_v1(place: Place) -> None:
    """Follow each frame of all registers on many streams, half of which are read slowly, and read all beside them."""

    def work(number: int) -> None:
        with client.connect(place.grpc, token=LOAD, timeout_s=CALL_S) as cell:
            if number % 4 == 3:
                while True:
                    cell.read("cell/**")
            stream = cell.subscribe("cell/**", every_frame=number % 2 == 0, frames=number % 4 == 1)
            for _ in stream:
                if number % 8 == 0:
                    time.sleep(1)  # a client that falls behind

    in_threads(48, work)


@contextmanager
def other_shmio_v1(place: Place) -> Iterator[Callable[[], object]]:
    """Read, and follow each frame of the source beside it: none may be lost."""
    with client.connect(place.grpc, token=OTHER, timeout_s=CALL_S) as cell:
        stream = cell.subscribe(REGISTER, every_frame=True)
        missed: list[int] = []

        def follow() -> None:
            with suppress(ShmioError):
                missed.extend(update.missed for update in stream if update.missed)

        follower = threading.Thread(target=follow, daemon=True)
        follower.start()

        def ask() -> None:
            cell.read(REGISTER)
            if missed or not follower.is_alive():
                raise LostError(f"frames of the stream: {missed or 'its end'}")

        yield ask
        stream.close()


# -- MQTT ----------------------------------------------------------------------------------------------------------


def mqtt_client(place: Place) -> MqttClient:
    address = Address.parse(place.mqtt)
    made = MqttClient(CallbackAPIVersion.VERSION2, protocol=MQTTv5, reconnect_on_failure=False)
    made.connect(address.host, address.port)
    return made


def load_mqtt(place: Place) -> None:
    """Subscribe to everything again and again, so that the broker sends all retained messages, beside all changes."""

    def work(_: int) -> None:
        one = mqtt_client(place)

        def leave(*_: object) -> None:
            one.unsubscribe("shmio/#")

        def come(*_: object) -> None:
            one.subscribe("shmio/#", qos=1)

        one.on_subscribe, one.on_unsubscribe = leave, come
        one.subscribe("shmio/#", qos=1)
        one.loop_forever()

    in_threads(16, work)


@contextmanager
def other_mqtt(place: Place) -> Iterator[Callable[[], object]]:
    """Subscribe to a register, until its retained value comes."""
    received, lost = threading.Event(), threading.Event()
    one = mqtt_client(place)
    one.on_message = lambda *_: received.set()
    one.on_disconnect = lambda *_: lost.set()
    one.loop_start()
    topic = f"shmio/{place.instance}/{REGISTER}/out"

    def ask() -> None:
        received.clear()
        one.subscribe(topic, qos=1)
        if not received.wait(CALL_S) or lost.is_set():
            raise LostError("the connection" if lost.is_set() else "the value")
        one.unsubscribe(topic)

    yield ask
    one.on_disconnect = None
    one.disconnect()
    one.loop_stop()


# -- OPC UA --------------------------------------------------------------------------------------------------------


def load_opcua(place: Place) -> None:
    """Monitor two arrays with 4,000 items at 50 Hz, and read them beside it."""
    from asyncua import Client

    class Sink:
        def datachange_notification(self, *_: object) -> None:
            """Take a change."""

    async def work() -> None:
        async with Client(f"opc.tcp://{place.opcua}", timeout=CALL_S) as one:
            nodes = [one.get_node(f"ns=2;s={wide}") for wide in WIDE]
            for _ in range(4):
                subscription = await one.create_subscription(20, Sink())
                await subscription.subscribe_data_change(nodes * 500, sampling_interval=20)
            while True:
                await one.read_values(nodes * 50)

    async def again() -> None:
        while True:
            with suppress(Exception):  # a limit refuses it
                await work()

    asyncio.run(again())


@contextmanager
def other_opcua(place: Place) -> Iterator[Callable[[], object]]:
    from asyncua.sync import Client

    with Client(f"opc.tcp://{place.opcua}", timeout=CALL_S) as one:
        node = one.get_node(f"ns=2;s={REGISTER}")
        yield node.read_value


# -- the fabric ----------------------------------------------------------------------------------------------------


MISSING: Final = f"shmio.{FABRIC_CELL}.cell.missing"


async def plain_nats(place: Place, **options: Any) -> Any:
    """Connect as a program without credentials, which may read."""
    import nats

    async def ignore(_: Exception) -> None:
        """The server reports what a slow client has lost."""

    return await nats.connect(f"nats://{place.fabric}", error_cb=ignore, **options)


def load_fabric(place: Place) -> None:
    """Receive all frames many times, and ask the uplink for all that it keeps, and the server for the registry."""

    async def load() -> None:
        one = await plain_nats(place)
        entry = {"last_by_subj": f"$KV.shmio_cells.{FABRIC_CELL}"}
        request = json.dumps({"stream": await stream_of(one), "first": 1, "last": 1 << 62}).encode()

        async def take(_: object) -> None:
            """Take a message."""

        for _ in range(4):
            await one.subscribe(f"shmio.{FABRIC_CELL}.*.live", cb=take)
        inbox = one.new_inbox()
        await one.subscribe(inbox, cb=take, pending_bytes_limit=1 << 40, pending_msgs_limit=1 << 30)
        while True:
            for _ in range(8):
                await one.publish(MISSING, request, reply=inbox)
                await one.publish("$JS.API.STREAM.MSG.GET.KV_shmio_cells", json.dumps(entry).encode(), reply=inbox)
                await one.publish("$JS.API.STREAM.INFO.KV_shmio_layouts", b'{"subjects_filter":">"}', reply=inbox)
            await one.flush()

    async def again() -> None:
        while True:
            with suppress(Exception):  # a limit ends the connection
                await load()

    async def work() -> None:
        await asyncio.gather(*(again() for _ in range(16)))

    asyncio.run(work())


async def stream_of(one: Any) -> int:
    """Return the number of the stream that the uplink publishes."""
    next_one = asyncio.get_running_loop().create_future()

    async def take(message: Any) -> None:
        if not next_one.done():
            next_one.set_result(int.from_bytes(message.data[8:16], "little"))

    watching = await one.subscribe(f"shmio.{FABRIC_CELL}.cell.live", cb=take)
    found: int = await next_one
    await watching.unsubscribe()
    return found


@contextmanager
def other_fabric(place: Place) -> Iterator[Callable[[], object]]:
    """Ask for the newest message, as a mirror does that has missed it, and receive each number beside it."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    lost: list[int] = []
    last = [0]

    def of(work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, loop).result(CALL_S)

    async def follow(message: Any) -> None:
        number = int.from_bytes(message.data[16:24], "little")
        if last[0] and number != last[0] + 1:
            lost.append(number)
        last[0] = number

    one = of(plain_nats(place, allow_reconnect=False))
    stream = of(stream_of(one))
    of(one.subscribe(f"shmio.{FABRIC_CELL}.cell.live", cb=follow))

    def ask() -> None:
        request = json.dumps({"stream": stream, "first": last[0], "last": last[0]}).encode()
        of(one.request(MISSING, request, timeout=CALL_S))
        if lost:
            raise LostError(f"messages before {lost}")

    yield ask
    of(one.close())
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    loop.close()


# -- the supervisor's control socket -------------------------------------------------------------------------------


def load_control(place: Place) -> None:
    in_threads(8, lambda _: control.request(place.control, control.Where(), CALL_S))


@contextmanager
def other_control(place: Place) -> Iterator[Callable[[], object]]:
    yield lambda: control.request(place.control, control.Where(), CALL_S)


ENDPOINTS: Final[Mapping[str, Endpoint]] = {
    "page": Endpoint("web", load_page, other_page),
    "metrics": Endpoint("metrics", load_metrics, other_scraper),
    "simlog v1": Endpoint("grpc", load_v1, other_v1),
    "simlog v2": Endpoint("grpc", load_v2, other_v2),
    "shmio.v1": Endpoint("grpc", load_shmio_v1, other_shmio_v1),
    "mqtt": Endpoint("mqtt", load_mqtt, other_mqtt),
    "opcua": Endpoint("opcua", load_opcua, other_opcua),
    "fabric": Endpoint("fabric", load_fabric, other_fabric),
    "control": Endpoint("cell", load_control, other_control),
}


@contextmanager
def started(folder: Path, instance: str) -> Iterator[tuple[Cell, Place]]:
    """Run a cell with all endpoints."""
    with ExitStack() as stack:
        names = ("web", "metrics", "mqtt", "opcua", "fabric")
        plc, remote, *others = (stack.enter_context(reserved_port()) for _ in range(2 + len(names)))
        shutil.copy(ROOT / "db201.db", folder)
        addresses = {name: str(address) for name, address in zip(names, others, strict=True)}
        digests = {
            name: hashlib.sha256(token.encode()).hexdigest() for name, token in (("load", LOAD), ("other", OTHER))
        }
        text = CONFIG.format(instance=instance, period_ms=20, plc=plc, grpc=remote)
        (folder / "supervisor.toml").write_text(text + MORE.format(**addresses, **digests))
        cell = Cell(folder, instance, remote)
        cell.up()
        stack.callback(cell.down)
        socket = control_socket(instance)
        yield cell, Place(grpc=str(remote), control=socket, instance=instance, **addresses)


def control_socket(instance: str) -> str:
    from shmio.segment import Segment

    with Segment.open(instance) as segment:
        return segment.header.control


def measured(ask: Callable[[], object], for_s: float) -> Delays:
    """Make one request after the other for some time. What is lost once, is lost: there is no second connection."""
    found = Delays()
    until_s = time.monotonic() + for_s
    while time.monotonic() < until_s:
        begun_s = time.monotonic()
        try:
            ask()
        except Exception as error:  # noqa: BLE001  each client has errors of its own
            found.lost.append(f"{type(error).__name__}: {error}"[:200])
            return found
        found.delays_ms.append(1000 * (time.monotonic() - begun_s))
        time.sleep(PAUSE_S)
    return found


def yield_to_others() -> None:
    """Let other processes go first, also where the kernel schedules by sessions, sched(7)."""
    if os.sched_getscheduler(0) == os.SCHED_RR:  # chrt -r 2 keeps the other programs of a busy host away
        os.sched_setparam(0, os.sched_param(1))
    os.setsid()
    os.nice(NICE)
    with suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICE))


@contextmanager
def beside(*arguments: str) -> Iterator[int]:
    """Run this program as a load, and yield its pid when the load begins."""
    command = [sys.executable, "-m", "tests.faults.one_client_too_many", *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as load:
        try:
            assert load.stdout is not None
            load.stdout.readline()
            yield load.pid
        finally:
            load.kill()


@contextmanager
def busy_processors() -> Iterator[None]:
    """Keep all processors busy, with processes that yield to others."""
    with ExitStack() as stack:
        for _ in os.sched_getaffinity(0):
            stack.enter_context(beside("--busy"))
        yield


def used_s(pid: int) -> float:
    """Return the processor time in s that a process has used, proc(5); NaN if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return math.nan
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(cell: Cell, place: Place, name: str, for_s: float, alone_s: float) -> Result:
    """Load an endpoint of a running cell, and return the result."""
    endpoint = ENDPOINTS[name]
    before = cell.processes()
    with endpoint.other(place) as ask:
        ask()
        with busy_processors():
            alone = measured(ask, alone_s)
        with beside("--load", json.dumps(asdict(place)), name) as load:
            pids = load, before[endpoint.process]["pid"]
            begun_s, begun = time.monotonic(), [used_s(pid) for pid in pids]
            during = measured(ask, for_s)
            lasted_s = time.monotonic() - begun_s
            used = [used_s(pid) - one for pid, one in zip(pids, begun, strict=True)]
    after = cell.processes()
    restarts = sum(
        one["pid"] != before[process]["pid"] or one["restarts"] > before[process]["restarts"]
        for process, one in after.items()
    )
    return Result(alone, during, restarts, *(one / lasted_s for one in used))


def main(arguments: Sequence[str] | None = None) -> int:
    """Load each endpoint, and print the table; return 1 if a process was restarted, or a client lost something."""
    parser = argparse.ArgumentParser(description="load each endpoint with one client of the role read")
    parser.add_argument("--for", dest="for_s", type=float, default=60.0, metavar="SECONDS", help="length of each load")
    parser.add_argument("--alone", dest="alone_s", type=float, default=10.0, metavar="SECONDS")
    parser.add_argument("endpoint", nargs="*", help=f"which ones: {', '.join(ENDPOINTS)} (default: all)")
    parser.add_argument("--load", type=json.loads, help=argparse.SUPPRESS)  # the process that is the load
    parser.add_argument("--busy", action="store_true", help=argparse.SUPPRESS)  # a process that is only busy
    given = parser.parse_args(arguments)
    if given.busy or given.load is not None:
        yield_to_others()
        print("begun", flush=True)
        while given.busy:
            pass
        ENDPOINTS[given.endpoint[0]].load(Place(**given.load))
    faults = 0
    with (
        tempfile.TemporaryDirectory() as folder,
        started(Path(folder), f"many-{secrets.token_hex(3)}") as (cell, place),
    ):
        print("| endpoint | delay in ms alone: median / 95 % / most | beside the load | median | requests", end="")
        print(" | processors used by load and endpoint | faults |\n|---|---|---|---|---|---|---|", flush=True)
        for name in given.endpoint or ENDPOINTS:
            found = run(cell, place, name, given.for_s, given.alone_s)
            faults += len(found.faults)
            texts = (
                name,
                found.before,
                found.during,
                found.times,
                len(found.during.delays_ms),
                f"{found.load:.2f}, {found.endpoint:.2f}",
                "; ".join(found.faults) or "none",
            )
            print(f"| {' | '.join(map(str, texts))} |", flush=True)
        if faults:
            print(cell.logs()[-4000:])
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
