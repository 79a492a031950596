"""A process with gRPC subscribers: a connection and a SimlogAPI v1 Subscribe call for each path.

With ``--stamps``, the values are times that plc.py wrote. Each message is kept as (time of the change, instance's
clock when the frame was published, time of arrival), all in ns. The first and the last are CLOCK_MONOTONIC.
"""

from __future__ import annotations

import argparse
import threading
import time

import grpc
from common import tell, wait_for_parent

from shmio.wire import simlog_v1_pb2 as wire
from shmio.wire import simlog_v1_pb2_grpc as service


class Subscriber:
    """A thread that follows one stream."""

    def __init__(self, target: str, path: str, *, stamps: bool) -> None:
        options = [("grpc.use_local_subchannel_pool", 1)]  # else all channels of a process share one connection
        self._channel = grpc.insecure_channel(target, options=options)
        stub = service.SimlogAPIStub(self._channel)  # type: ignore[no-untyped-call]  # generated code
        self._call = stub.Subscribe(wire.TopicDescriptor(path=path))
        self._keep = stamps
        self.first = threading.Event()
        self.messages = 0
        self.stamps: list[tuple[int, int, int]] = []
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        try:
            for message in self._call:
                received_ns = time.monotonic_ns()
                self.messages += 1
                if self._keep:
                    self.stamps.append((int(message.value), message.timeStamp.stamp.nsec, received_ns))
                self.first.set()
        except grpc.RpcError as error:
            if error.code() is not grpc.StatusCode.CANCELLED:
                raise

    def stop(self) -> None:
        self._call.cancel()
        self._thread.join()
        self._channel.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target")
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--stamps", action="store_true")
    arguments = parser.parse_args()
    subscribers = [Subscriber(arguments.target, path, stamps=arguments.stamps) for path in arguments.paths]
    for subscriber in subscribers:
        if not subscriber.first.wait(10):
            raise SystemExit("no first value within 10 s")
    tell("ready")
    wait_for_parent()
    for subscriber in subscribers:
        subscriber.stop()
    tell({"messages": sum(s.messages for s in subscribers), "stamps": [s.stamps for s in subscribers]})


if __name__ == "__main__":
    main()
