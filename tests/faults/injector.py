"""A client that injects until it is killed: ``python -m tests.faults.injector ORDER``.

``injecting`` and ``chaining`` start it. It creates an injection over one word, prints a line when that
is done, and gives values until its standard input ends. Then it lifts the injection. It also ends
when its injection is lifted, or when it cannot reach the instance any more.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import shmio
from shmio.errors import ShmioError
from shmio.model.values import Outcome, OutcomeKind
from tests.faults.truth import Truth

PAUSE_S = 0.05
CALL_S = 20.0
WAYS = ("local", "v1", "shmio")
"""How a client injects: attached, by SimlogAPI v1 (which keeps no injection), or by shmio.v1."""


@dataclass(frozen=True)
class Order:
    """The order to a client.

    Over ``/out``, the client injects ``first``, ``first + step`` and so on. With ``relay``, it injects instead the
    value that it receives from injections of lower priority, plus 1.
    """

    instance: str
    grpc: str
    way: str
    source: str
    direction: str
    keep: bool
    name: str
    first: int
    given: str
    """Path of the truth file in which the client records each value before it injects it."""
    register: str
    """Name of the word under the injection."""
    step: int = 1
    priority: int = 0
    relay: bool = False

    @property
    def word(self) -> str:
        """Path of the word."""
        return f"{self.source}/{self.register}"

    def to_json(self) -> str:
        """Encode the order as a command-line argument."""
        return json.dumps(asdict(self))


class Client:
    """What clients share, whichever way they inject: they record each value before they inject it."""

    def __init__(self, order: Order) -> None:
        self.order = order
        self.stopping = threading.Event()
        self._given = Truth(Path(order.given))
        self.when_told(self.stopping.set, sys.stdin.read)

    def when_told(self, act: Callable[[], object], told: Callable[[], object] | None = None) -> None:
        """Call ``act`` in a thread when ``told`` returns; without ``told``, when the client is to end."""

        def wait() -> None:
            (told or self.stopping.wait)()
            act()

        threading.Thread(target=wait, daemon=True).start()

    def stands(self) -> None:
        """Print the line that says that the injection is laid."""
        print("stands", flush=True)

    def numbers(self) -> Iterator[int]:
        """Yield values to give, at intervals, until the client is to end."""
        number = self.order.first
        while not self.stopping.wait(PAUSE_S):
            yield self.note(number)
            number += self.order.step

    def note(self, number: int) -> int:
        """Record that readers may see this value from now on, and return it.

        Only the first time is recorded: a client may receive the same original more than once.
        """
        if self._given.since_ns(number) is None:
            self._given.land(number, time.monotonic_ns())
        return number


def local(client: Client) -> None:
    """Inject as an attached program. Over ``/in`` it replaces each value by the next higher one."""
    order = client.order
    with (
        shmio.attach(order.instance, writable=True) as cell,
        cell.inject(f"{order.word}/{order.direction}", keep=order.keep, name=order.name) as shadow,
    ):
        client.stands()
        if order.direction == "out":
            for number in client.numbers():
                if gone(shadow.set({order.word: number})):
                    return
            return
        while not client.stopping.is_set():
            for write in shadow.diverted(timeout_s=PAUSE_S):
                for value in write.values.values():
                    assert isinstance(value, int)
                    shadow.set({order.word: client.note(value + 1)})
            if not any(one.number == shadow.number for one in cell.injections(order.source)):
                return


def gone(outcomes: list[Outcome]) -> bool:
    """Return whether the outcomes show that the injection was lifted."""
    return any(outcome.kind is OutcomeKind.REJECTED and "no injection" in outcome.text for outcome in outcomes)


def v1(client: Client) -> None:
    """Inject by SimlogAPI v1: read the stream of originals, and publish values to the shadow."""
    import grpc

    from shmio.wire.simlog_v1_pb2 import InjectRequest, PubRequest, ROSMessage, TopicDescriptor
    from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

    order = client.order
    target, shadow = (TopicDescriptor(path=f"{order.word}/{part}") for part in (order.direction, order.name))
    with grpc.insecure_channel(order.grpc) as channel:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]

        def publish(number: int) -> None:
            data = ROSMessage(type="int", value=str(client.note(number)))
            stub.Publish(iter([PubRequest(topic=shadow, data=data)]), timeout=CALL_S)

        originals = stub.Inject(InjectRequest(injected=shadow, target=target))
        try:
            originals.initial_metadata()
            client.stands()
            if order.direction == "out":
                for number in client.numbers():
                    publish(number)
                    if not originals.is_active():
                        return
                return
            client.when_told(originals.cancel)
            for original in originals:
                publish(int(original.value) + 1)
        except grpc.RpcError:
            return  # the server has gone, or the client is to end
        finally:
            originals.cancel()


def own(client: Client) -> None:
    """Inject by shmio.v1."""
    from shmio.client import Client as Remote
    from shmio.client import Target

    order = client.order
    path = f"{order.word}/{order.direction}"
    with (
        Remote(Target(order.grpc)) as remote,
        remote.inject(
            path, priority=order.priority, keep=order.keep, name=order.name,
            originals=order.relay or order.direction == "in",
        ) as shadow,
    ):  # fmt: skip
        client.stands()
        if order.direction == "out" and not order.relay:
            for number in client.numbers():
                shadow.set({order.word: number})
            return
        client.when_told(shadow.close)
        for update in shadow:
            if value := int(update[order.word]):  # 0: no injection gives a value
                shadow.send({order.word: client.note(value + 1)})


def main() -> None:
    client = Client(Order(**json.loads(sys.argv[1])))
    ways: dict[str, Callable[[Client], None]] = {"local": local, "v1": v1, "shmio": own}
    try:
        ways[client.order.way](client)
    except ShmioError as error:
        print(f"ended: {error}", flush=True)


if __name__ == "__main__":
    main()
