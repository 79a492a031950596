"""What each call needs: the one table. A call that is not in it is refused."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

READ: Final = "read"
WRITE: Final = "write"
INJECT: Final = "inject"
CONTROL: Final = "control"

_SERVICES: Final[Mapping[str, Mapping[str, str]]] = {
    "simulation.server.SimlogAPI": {
        READ: "GetTopic Subscribe",
        WRITE: "Publish",
        INJECT: "Inject",
        CONTROL: "setStepSize step",
    },
    "simlog.server.SimlogAPI": {
        READ: "GetTopicInfo CreateSubscriber Subscribe Read",
        WRITE: "Publish Write PublishSynch",
        INJECT: "Inject",
    },
    "shmio.v1.Shmio": {
        READ: "GetLayouts GetStatus Read Subscribe ListInjections WatchClock",
        WRITE: "Write Simulate",
        INJECT: "Inject Declare Lift LiftAll",
        CONTROL: "Step Steps SetStepSize Play Pause Replay",
    },
    "com.ttsnetwork.simulator3.SimServerAPI": {
        READ: "subscribe",
        CONTROL: "step start stop pause",
    },
    "grpc.health.v1.Health": {READ: "Check Watch List"},
    "grpc.reflection.v1alpha.ServerReflection": {READ: "ServerReflectionInfo"},
}
"""Services, and in each the calls of a role."""


def _calls() -> Iterator[tuple[str, str]]:
    for service, roles in _SERVICES.items():
        for role, names in roles.items():
            for name in names.split():
                yield f"/{service}/{name}", role


NEEDS: Final[Mapping[str, str]] = dict(_calls())
"""The role that a call needs, by its full name."""
