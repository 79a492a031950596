"""The limits of the gRPC endpoint equal those in docs/reference/grpc-access.md."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shmio.client import calls
from shmio.endpoints import commands_in_flight
from shmio.endpoints.grpc.server import server
from shmio.endpoints.grpc.server.call_guard import CallLimits
from shmio.endpoints.grpc.services import simlog_v2
from shmio.endpoints.grpc.streams import back_pressure, outbox

PAGE = Path(__file__).parents[4] / "docs/reference/grpc-access.md"
ROW = re.compile(r"^\| (.+?) \| (\d+)( MiB| s)? \|", re.MULTILINE)
LIMITS = CallLimits()
MIB = 1 << 20
SILENT_MS = sum(value for name, value in server.OPTIONS if name.startswith("grpc.keepalive_time"))


@pytest.mark.parametrize(
    ("what", "limit"),
    [
        ("a message from a client", server.MAX_REQUEST_BYTES // MIB),
        ("connections open at once, on all addresses", LIMITS.connections),
        ("calls open at once, on all addresses", LIMITS.calls),
        (f"of these, reserved for clients with fewer than {LIMITS.share} calls", LIMITS.reserve),
        ("time until the message of a call with one message comes", LIMITS.message_s),
        ("values of one topic that wait for a client", outbox.TOPIC_BOUND),
        ("values of all topics of a stream that wait", outbox.STATE_BOUND),
        ("messages of `/in` that wait in a stream", outbox.EVENT_BOUND),
        ("bytes of values that wait in a stream; the same for messages of `/in`", back_pressure.BOUND_BYTES // MIB),
        ("bytes that wait in all streams", back_pressure.TOTAL_BYTES // MIB),
        ("subscribers of version 2", simlog_v2.MAX_SUBSCRIBERS),
        ("topics of a subscriber", simlog_v2.MAX_TOPICS),
        ("topics of all subscribers", simlog_v2.MAX_ALL_TOPICS),
        ("characters of a subscriber's name or uuid", simlog_v2.MAX_NAME),
        ("elements of a value of version 2, or of one `Read`", simlog_v2.MAX_ELEMENTS),
        ("registers of a value of version 2, or of one `Read`", simlog_v2.MAX_MEMBERS),
        ("events in flight for the clients' writes to a source", commands_in_flight.MAX_OPEN),
        ("a client whose host is silent", SILENT_MS // 1000),
    ],
)
def test_a_limit_is_as_documented(what: str, limit: float) -> None:
    assert {name: int(number) for name, number, _ in ROW.findall(PAGE.read_text())}[what] == limit


def test_the_clients_keepalive_interval_is_allowed_by_the_server() -> None:
    """Otherwise gRPC would end the connection of a client with idle streams after a minute or two."""
    allowed_ms = dict(server.OPTIONS)["grpc.http2.min_ping_interval_without_data_ms"]
    assert allowed_ms < dict(calls.OPTIONS)["grpc.keepalive_time_ms"]
