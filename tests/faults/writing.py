"""Programs that write to each PLC, locally and by gRPC, and check what the PLC got."""

from __future__ import annotations

import random
import time
from collections import deque
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import count, islice

import grpc

from shmio.errors import CommandError
from shmio.local.attach import Attachment
from shmio.model.values import OutcomeKind
from shmio.wire.simlog_v1_pb2 import PubRequest, ROSMessage, TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from tests.faults.checker import Checker
from tests.faults.checks import Source
from tests.faults.local import attached
from tests.faults.remote import BREAKS, CALL_S, OPTIONS
from tests.faults.write_checks import PublishCheck, WriteCheck

PAUSE_S = 0.05
REMEMBERED = 200


def write(checker: Checker, source: Source) -> None:
    """Write locally, check each outcome at once, and check it again later."""
    chance = random.Random(checker.description.seed)
    counts = checker.counts(f"writes {source.name}")
    check = WriteCheck(source, checker.complain, counts)
    past: deque[int] = deque(maxlen=REMEMBERED)
    value = 0  # even values; published ones are odd

    def work(attachment: Attachment) -> None:
        nonlocal value
        while attachment.current and not checker.stopping.wait(PAUSE_S):
            value += 2
            try:
                (outcome,) = attachment.write({f"{source.name}/command": value}, chance.choice((0.05, 0.5, 2.0)))
                kind, text = outcome.kind, outcome.text
            except CommandError as error:
                kind, text = OutcomeKind.REJECTED, str(error)
            check.outcome(value, kind, text)
            past.append(value)
            check.again(past[0])

    attached(checker, work, writable=True)


def publish(checker: Checker, source: Source) -> None:
    """Publish by gRPC, a few values a call, and check at once and later what the PLC got."""
    chance = random.Random(checker.description.seed)
    check = PublishCheck(source, checker.complain, checker.counts(f"published {source.name}"))
    values = count(1, 2)
    past: deque[int] = deque(maxlen=REMEMBERED)

    def requests(batch: Sequence[int]) -> Iterator[PubRequest]:
        topic = TopicDescriptor(path=f"{source.name}/remote/in")
        for value in batch:
            yield PubRequest(topic=topic, data=ROSMessage(value=str(value)))
            checker.stopping.wait(chance.choice((0.0, PAUSE_S)))

    while not checker.stopping.wait(PAUSE_S):
        with grpc.insecure_channel(checker.description.grpc, options=OPTIONS) as channel:
            stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
            try:
                while not checker.stopping.wait(PAUSE_S):
                    batch = list(islice(values, chance.choice((1, 2, 10))))
                    for value in batch:
                        check.sent(value, time.monotonic_ns())
                    past.extend(batch)
                    stub.Publish(requests(batch), timeout=CALL_S)
                    check.look(past, slack_ns=checker.slack_ns)
                    check.forget(past[0] - 1)
            except grpc.RpcError as error:
                if error.code() not in BREAKS:
                    checker.complain(f"publishing to {source.name} ended with {error.code()}: {error.details()}")


def main() -> None:
    checker = Checker()
    for source in checker.sources:
        if source.landed is not None:
            checker.work(partial(write, checker, source))
            checker.work(partial(publish, checker, source))
    checker.run()


if __name__ == "__main__":
    main()
