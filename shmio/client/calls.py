"""Endpoints' addresses, requests, answers and gRPC errors, for both clients. This module does no I/O."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

import grpc

from shmio.errors import (
    CommandError,
    ConflictError,
    EndpointError,
    LostError,
    PathError,
    RemoteError,
    ShmioError,
    UnknownClientError,
    ValueRangeError,
)
from shmio.messages import value_to_wire
from shmio.model.clock import Clock, ClockMode
from shmio.model.replay import ReplayChanges, ReplayStatus
from shmio.model.snapshot import SnapshotInfo
from shmio.model.values import Outcome, OutcomeKind
from shmio.wire import shmio_v1_pb2 as wire

STEP_PATIENCE_S: Final = 60.0
SERVICE: Final = wire.DESCRIPTOR.services_by_name["Shmio"].full_name
WRITE_PATIENCE_S: Final = 30.0
"""Time in s to add to the time-out of a write, because a source may have long cycles."""
_SEARCH_PATIENCE_S: Final = 600.0
"""Time-out of a search in a recording, in s."""
SNAPSHOT_S: Final = 100.0
"""Time-out in s of a call that saves or restores a snapshot. The instance's own time-outs are shorter."""
OPTIONS: Final = [
    ("grpc.max_receive_message_length", 64 << 20),
    ("grpc.keepalive_time_ms", 20_000),
    # Reconnect soon after an endpoint was restarted.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 1_000),
]

_CLOCK_KEYS: Final = ("virtual", "step", "time_ns", "step_size_ns", "playing", "rate", "note")
_ERRORS: Final[Mapping[grpc.StatusCode, type[ShmioError]]] = {
    grpc.StatusCode.NOT_FOUND: PathError,
    grpc.StatusCode.INVALID_ARGUMENT: ValueRangeError,
    grpc.StatusCode.FAILED_PRECONDITION: CommandError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: EndpointError,
    grpc.StatusCode.ALREADY_EXISTS: ConflictError,
}
_REMOTE: Final[Mapping[grpc.StatusCode, type[RemoteError]]] = {
    grpc.StatusCode.UNAVAILABLE: LostError,
    grpc.StatusCode.UNAUTHENTICATED: UnknownClientError,
}
_PLAIN: Final = {
    "Connection refused": "nothing listens on that port",
    "No such file or directory": "there is no such socket",
    "Domain name not found": "there is no host of that name",
    "Cancelling all calls": "the endpoint has stopped",
    "Socket closed": "the endpoint has stopped",
    "CANCELLED": "the endpoint has stopped",
}
"""Short texts that replace error messages of gRPC, by a part of the message."""
_TLS: Final = {
    "Hostname Verification": "its certificate does not name this host; use a name or address from the certificate",
    "WRONG_VERSION_NUMBER": "the endpoint does not use TLS; leave the CA out (ca, --ca)",
    "CERTIFICATE_VERIFY_FAILED": "its certificate is not from the CA given (ca, --ca), or has expired",
}
"""Texts that replace gRPC's messages about TLS errors, by a part of gRPC's message."""
_UNIX: Final = "unix:"
_MEANING: Final = {
    grpc.StatusCode.UNAVAILABLE: "no instance serves there, or it has ended",
    grpc.StatusCode.DEADLINE_EXCEEDED: "the endpoint did not answer in time",
    grpc.StatusCode.UNAUTHENTICATED: "the endpoint does not know this client",
    grpc.StatusCode.PERMISSION_DENIED: "the endpoint does not permit this call",
    grpc.StatusCode.UNIMPLEMENTED: "the endpoint does not serve shmio.v1, or it is older than this client",
}


@dataclass(frozen=True, slots=True)
class Target:
    """Address and credentials of an endpoint; see the arguments of :func:`shmio.client.connect`.

    Raises:
        ValueRangeError: The token would go to another host in plain text.
    """

    address: str
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    token: str | None = None
    token_in_plain_text: bool = False

    def __post_init__(self) -> None:
        if self.token is None or self.ca is not None or self.token_in_plain_text or _is_here(self.address):
            return
        raise ValueRangeError(
            f"{self.address}: shmio does not send a token to another host in plain text, where others could read it; "
            "name the CA of the host's certificate (ca, --ca), or allow it (token_in_plain_text, --token-in-plain-text)"
        )

    @property
    def credentials(self) -> grpc.ChannelCredentials | None:
        """Credentials for TLS; None for plain text. Raise OSError if a file cannot be read."""
        if self.ca is None:
            return None
        ca, key, certificate = (
            None if file is None else file.read_bytes() for file in (self.ca, self.key, self.certificate)
        )
        return grpc.ssl_channel_credentials(ca, key, certificate)

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """The gRPC metadata of every call: the token, if there is one."""
        return () if self.token is None else (("authorization", f"Bearer {self.token}"),)

    def error(self, error: Any, *, answered: bool = False) -> ShmioError:
        """Convert the error of a gRPC call to an error of shmio; ``answered``: the call had answers before."""
        code, details = error.code(), error.details() or ""
        if code is grpc.StatusCode.CANCELLED and details == "CANCELLED":  # an endpoint that stops ends some calls so
            code = grpc.StatusCode.UNAVAILABLE
        if "message larger than max" in details:  # text of gRPC
            details = f"the values are too large for one message; send or request fewer at once ({details})"
        if kind := _ERRORS.get(code):
            return kind(details)
        error_type = _REMOTE.get(code, RemoteError)
        if tls := next((meaning for words, meaning in _TLS.items() if words in details), None):
            return error_type(f"{self.address}: {tls}")
        closed = "Socket closed" in details and not answered and not self.address.startswith(_UNIX)
        details = next((plain for words, plain in _PLAIN.items() if words in details), details)
        if closed and self.ca is None:
            details += ", or it speaks TLS; then name the CA of its certificate (ca, --ca)"
        elif closed and self.certificate is None:
            details += ", or it needs a client certificate (certificate and key)"
        return error_type(f"{self.address}: {_MEANING.get(code, code.name)}{f': {details}' if details else ''}")

    def fail(self, error: Any, *, answered: bool = False) -> NoReturn:
        """Raise the error of a gRPC call as an error of shmio; ``answered``: the call had answers before."""
        raise self.error(error, answered=answered) from None


def unanswered(target: Target) -> RemoteError:
    """Return the error for a call that the endpoint has not answered in time."""
    return RemoteError(f"{target.address}: the endpoint has not answered within {WRITE_PATIENCE_S:g} s")


def _is_here(address: str) -> bool:
    host = address.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or address.startswith(_UNIX)


def ns(dt_s: float | None) -> int:
    """Convert the length of a step to ns. None, which stands for the step size, becomes 0.

    Raises:
        ValueRangeError: The length is out of range.
    """
    if dt_s is None:
        return 0
    if not 0 < dt_s <= 3600:
        raise ValueRangeError(f"a step must be from 0.001 ms to 3600000 ms (1 h), not {dt_s * 1e3:g} ms")
    return max(1, round(dt_s * 1e9))


def read_request(patterns: Iterable[str], *, originals: bool) -> Any:
    """Return the request of the call Read, with the arguments of ``Client.read``."""
    return wire.ReadRequest(patterns=patterns, originals=originals)


def subscribe_request(
    patterns: Iterable[str], *, every_frame: bool, frames: bool, max_rate_hz: float, deadband: float
) -> Any:
    """Return the request of the call Subscribe, with the arguments of ``Client.subscribe``."""
    return wire.SubscribeRequest(
        patterns=patterns,
        mode=wire.MODE_EVERY_FRAME if every_frame else wire.MODE_LATEST,
        format=wire.FORMAT_FRAMES if frames else wire.FORMAT_VALUES,
        max_rate_hz=max_rate_hz,
        deadband=deadband,
    )


def write_request(values: Mapping[str, object], timeout_s: float | None, *, until_accepted: bool) -> Any:
    """Return the request of the call Write, with the arguments of ``Client.write``.

    Raises:
        ValueRangeError: A value has an unsupported Python type.
    """
    timeout_ms = round(1000 * (timeout_s or 0))
    return wire.WriteRequest(values=assignments(values), timeout_ms=timeout_ms, until_accepted=until_accepted)


def assignments(values: Mapping[str, object]) -> list[Any]:
    """Convert values by path to messages.

    Raises:
        ValueRangeError: A value has an unsupported Python type.
    """
    return [wire.Assignment(path=path, value=value_to_wire(value, path)) for path, value in values.items()]


def outcomes(paths: Iterable[str], found: Any) -> list[Outcome]:
    """Return an outcome for each path, in the order of the paths, from the outcomes in an answer."""
    ends = list(found)
    paths = list(paths)
    if len(ends) == 1:
        ends *= len(paths)
    return [Outcome(path, _kind(end.kind), end.reason) for path, end in zip(paths, ends, strict=True)]


def _kind(kind: int) -> OutcomeKind:
    known = wire.Outcome.Kind.values()
    return OutcomeKind[wire.Outcome.Kind.Name(kind).removeprefix("KIND_")] if kind in known else OutcomeKind.UNKNOWN


def clock(found: Any) -> Clock:
    """Convert a message to the state of the clock."""
    return Clock(
        ClockMode.VIRTUAL if found.virtual else ClockMode.WALL, found.step, found.time_ns, done=found.step,
        step_size_ns=found.step_size_ns, playing=found.playing, rate=found.rate, note=found.note,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Stepped:
    """A finished step: its number, and the simulation time after it."""

    step: int
    time_ns: int

    @classmethod
    def of(cls, found: Any) -> Stepped:
        """Convert a message about a finished step."""
        return cls(found.number, found.time_ns)


def steps_requests(count: int, dt_s: float | None) -> list[Any]:
    """Return the first requests of the call Steps.

    Raises:
        ValueRangeError: The count or the length is out of range.
    """
    if not 0 <= count < 1 << 32:
        raise ValueRangeError(f"{count} steps: from 0 to {(1 << 32) - 1} steps are allowed in one call")
    return [wire.StepsRequest(dt_ns=ns(dt_s), count=count)] if count else []


def status(found: Any) -> dict[str, Any]:
    """Return what ``shmio-supervisor status --json`` prints, from the answer of the call GetStatus."""
    return {
        "instance": found.instance,
        "mode": found.mode,
        "state": found.state,
        "segment": found.segment,
        "segment_bytes": found.segment_bytes,
        "supervisor": {"pid": found.supervisor.pid, "uptime_s": found.supervisor.uptime_s}
        if found.HasField("supervisor")
        else None,
        "processes": list(map(_process, found.processes)),
        "note": found.note,
        "clock": {name: getattr(found.clock, name) for name in _CLOCK_KEYS},
    }


def _process(found: Any) -> dict[str, Any]:
    process: dict[str, Any] = {
        "name": found.name,
        "kind": found.kind,
        "pid": found.pid if found.HasField("pid") else None,
        "state": found.state,
        "restarts": found.restarts,
        "uptime_s": found.uptime_s,
        "note": found.note,
        "counters": dict(found.counters),
    }
    if found.HasField("source"):
        source = found.source
        process |= {
            "quality": source.quality,
            "reason": source.reason,
            "cycle": source.cycle if source.HasField("cycle") else None,
            "rate_hz": source.rate_hz,
            "overruns": source.overruns,
            "real_time": source.real_time,
        }
    return process


def replay_request(changes: ReplayChanges) -> Any:
    """Return the request of the call Replay, in which times are text."""
    keys: dict[str, Any] = {**changes}
    for key in {"seek", "until"} & keys.keys():
        keys[key] = str(keys[key])
    return wire.ReplayRequest(**keys)


def replay_status(found: Any) -> list[ReplayStatus]:
    """Return the status of each replay in the answer of the call Replay."""
    return [
        ReplayStatus(
            one.source, one.time_s, one.position_s, one.length_s, one.speed, one.paused, one.loop, one.over,
            one.until_s if one.HasField("until_s") else None,
        )
        for one in found.sources
    ]  # fmt: skip


def snapshot(found: Any) -> SnapshotInfo:
    """Convert a message about a snapshot."""
    return SnapshotInfo(
        found.name, found.instance, found.saved_s, found.time_ns, found.step, found.size_bytes, dict(found.left_out),
        found.problem,
    )  # fmt: skip


def replay_patience_s(changes: ReplayChanges) -> float | None:
    """Return the time-out of a call of Replay, in s; None if the client's time-out applies."""
    return _SEARCH_PATIENCE_S if "change" in changes or "event" in changes else None
