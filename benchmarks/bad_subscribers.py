"""A process with troublesome gRPC subscribers: ``--unread`` never take a value, ``--moving`` come and go.

Each of the latter subscribes on its own connection, takes the present value, and leaves after ``STAY_S``. Every other
time it drops the connection in the middle of its call. Then it comes again. It subscribes to a register that does not
change, so that its own CPU use stays small.
"""

from __future__ import annotations

import argparse
import threading

import grpc
from common import tell, wait_for_parent

from shmio.wire import simlog_v1_pb2 as wire
from shmio.wire import simlog_v1_pb2_grpc as service

STAY_S = 1.0
OWN_CONNECTION = [("grpc.use_local_subchannel_pool", 1)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target")
    parser.add_argument("path")
    parser.add_argument("--unread", type=int, default=0)
    parser.add_argument("--moving", type=int, default=0)
    arguments = parser.parse_args()
    topic = wire.TopicDescriptor(path=arguments.path)
    stopping = threading.Event()
    visits = [0] * arguments.moving

    def come_and_go(place: int) -> None:
        while not stopping.is_set():
            channel = grpc.insecure_channel(arguments.target, options=OWN_CONNECTION)
            call = service.SimlogAPIStub(channel).Subscribe(topic)  # type: ignore[no-untyped-call]
            next(call)
            stopping.wait(STAY_S)
            visits[place] += 1
            if visits[place] % 2:
                call.cancel()
            channel.close()

    idle = [grpc.insecure_channel(arguments.target, options=OWN_CONNECTION) for _ in range(arguments.unread)]
    calls = [service.SimlogAPIStub(channel).Subscribe(topic) for channel in idle]  # type: ignore[no-untyped-call]
    for call in calls:
        call.initial_metadata()  # it is under way
    threads = [threading.Thread(target=come_and_go, args=(place,)) for place in range(arguments.moving)]
    for thread in threads:
        thread.start()
    tell("ready")
    wait_for_parent()
    stopping.set()
    for thread in threads:
        thread.join()
    for channel in idle:
        channel.close()
    if arguments.moving and not sum(visits):
        raise SystemExit("no subscriber received a value")
    tell({"visits": sum(visits)})


if __name__ == "__main__":
    main()
