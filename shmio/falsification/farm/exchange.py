"""What a search and its workers exchange: subjects, messages, the work queue, and the store of bundles.

A search offers its trials each ``BEAT_S`` on one subject, until it is over, and each worker answers
with its state. These messages are not stored: who is silent is gone. Tasks and results are messages
of a JetStream stream with the retention of a work queue. A worker acknowledges a task after the
server has stored the result. The server delivers a task again if it hears nothing for ``ACK_WAIT_S``.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

import msgspec

from shmio.errors import ConfigError, RemoteError
from shmio.fabric.connection import FARM, INSTALL, RETRY_S, Access, RefusedError, call_once
from shmio.fabric.registry import ELECTION, is_away
from shmio.libraries import library
from shmio.wording import counted

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.js import JetStreamContext
    from nats.js.object_store import ObjectStore

NAME: Final = FARM
OFFERS: Final = f"{NAME}.offer"
BEAT_S: Final = 1.0
"""Interval in s between two offers of a search, two answers of a worker, and two signs of life of a task."""
SILENT_S: Final = 5.0
"""Silence in s after which a worker counts as gone."""
OVER_S: Final = 15.0
"""Silence in s after which a search counts as over."""
ACK_WAIT_S: Final = 5.0
POLL_S: Final = 2.0
"""Maximum time in s that a request for messages waits at the server."""
KEPT_S: Final = 86_400.0
"""Time in s that the server keeps what a search that was killed has left there."""
REPLICAS: Final = 3
"""Number of servers of a cluster that keep the queue and the bundles."""
_NO_CLUSTER: Final = 10_074
"""Error code of a server that is alone, and so cannot keep more than one replica."""
_NO_PEERS: Final = 10_005
"""Error code of a cluster that has too few servers, or too few that run or have space."""
MAX_DELIVERIES: Final = 10
"""How often a task may be delivered until it counts as an error: perhaps it kills its workers."""

_Id = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{16}\Z")]
_Text = Annotated[str, msgspec.Meta(max_length=4096)]
_Result = TypeVar("_Result")

log = logging.getLogger("shmio.fabric")


class Offer(msgspec.Struct, frozen=True):
    """An offer of a search.

    Attributes:
        search: Id of the search.
        host: Name of its host.
        campaign: Name of the campaign file.
        digest: Digest of its bundle.
        root: Folder of the bundle's files on the host, which replaces the worker's folder in messages.
        config: Path of the configuration in the bundle.
        folder: Path of the campaign's folder in the bundle.
        limit_s: Maximum duration of a trial in s.
        environment: Versions that a worker must have.
        first: The least number of a task whose result still matters.
        over: True in the last offer.

    """

    search: _Id
    host: _Text
    campaign: _Text
    digest: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
    root: _Text
    config: _Text
    folder: _Text
    limit_s: Annotated[float, msgspec.Meta(gt=0, le=86_400)]
    environment: Annotated[dict[_Text, _Text], msgspec.Meta(max_length=1000)]
    first: int = 0
    over: bool = False


class Presence(msgspec.Struct, frozen=True):
    """A worker's answer to a search.

    Attributes:
        worker: Id of the worker.
        host: Name of its host.
        pid: Id of its process.
        jobs: Number of trials that it runs at once; 0 if it leaves.
        problem: Why it does not serve the search; empty if it does.

    """

    worker: _Id
    host: _Text
    pid: int
    jobs: int
    problem: _Text = ""


def host_name() -> str:
    """Return the name of this host."""
    return socket.gethostname()


def tasks_of(search: str) -> str:
    """Return the subject of a search's tasks."""
    return f"{NAME}.task.{search}"


def results_of(search: str) -> str:
    """Return the subject of a search's results."""
    return f"{NAME}.result.{search}"


def workers_of(search: str) -> str:
    """Return the subject of the answers of a search's workers."""
    return f"{NAME}.worker.{search}"


def task_consumer(search: str) -> str:
    """Return the name of the consumer from which the workers take a search's tasks."""
    return f"task-{search}"


def result_consumer(search: str) -> str:
    """Return the name of the consumer from which a search takes its results."""
    return f"result-{search}"


async def try_access(access: Access) -> None:
    """Connect once, and check as :func:`contact` does.

    Raises:
        ConfigError: The user needs other credentials.
        RemoteError: No server can be reached, or it refuses access.

    """
    try:
        await call_once(access, contact)
    except RefusedError as error:
        raise ConfigError(str(error)) from None


async def contact(client: Client) -> None:
    """Check that the server has JetStream and gives access to the queue. Create the queue if it is missing.

    If the queue and the bundles were created on a single server that has joined a cluster since, let as
    many servers keep them as those of a new cluster.

    Raises:
        RemoteError: It does not, or its cluster has too few servers.

    """
    errors, js = library("nats.errors", INSTALL), library("nats.js.errors", INSTALL)
    try:
        if not await open_queue(client):
            for name in (NAME, f"OBJ_{NAME}"):
                await _replicate(client, name)
    except js.ServiceUnavailableError as error:
        if is_away(error):
            raise RemoteError(f"the NATS servers do not answer about the stream {NAME}; {ELECTION}") from None
        raise RemoteError(
            "the NATS server has no JetStream; start it with -js, or set jetstream in its configuration"
        ) from None
    except js.APIError as error:
        raise RemoteError(f"the NATS server refuses access to {NAME}: {error.description or error}") from None
    except (errors.Error, OSError):
        raise RemoteError(
            f"the NATS server does not answer about its stream {NAME}; does it let this user publish to $JS.API.>, "
            f"$JS.ACK.> and {NAME}.>, and subscribe to _INBOX.> and {NAME}.>?"
        ) from None


async def _replicated(create: Callable[[int], Awaitable[_Result]]) -> _Result:
    """Create something on as many servers of a cluster as survive the loss of one; on a server that is alone, there.

    Raises:
        RemoteError: The cluster has too few servers.

    """
    js = library("nats.js.errors", INSTALL)
    try:
        return await create(REPLICAS)
    except js.APIError as error:
        if error.err_code == _NO_PEERS:
            raise RemoteError(
                f"the NATS cluster cannot keep {NAME} on {REPLICAS} servers: {error.description}; start its servers, "
                f"or use a server without a cluster"
            ) from None
        if error.err_code != _NO_CLUSTER:
            raise
        return await create(1)


async def _replicate(client: Client, name: str) -> None:
    """Let a cluster keep an existing stream on ``REPLICAS`` servers; if it cannot, log a warning."""
    errors, stream = library("nats.js.errors", INSTALL), client.jetstream()
    try:
        config = (await stream.stream_info(name)).config
    except errors.NotFoundError:
        return
    if (config.num_replicas or 1) >= REPLICAS:
        return
    try:
        await stream.update_stream(config.evolve(num_replicas=REPLICAS))
    except errors.APIError as error:
        if error.err_code != _NO_CLUSTER:
            log.warning(
                "%s is kept by only %s of the NATS cluster, so the loss of one may end a search: %s; start its "
                "servers, or run nats stream edit %s --replicas %d",
                name, counted(config.num_replicas or 1, "server"), error.description or error, name, REPLICAS,
            )  # fmt: skip


async def open_queue(client: Client) -> bool:
    """Create the stream, unless it exists; return whether it is new."""
    api, errors, stream = library("nats.js.api", INSTALL), library("nats.js.errors", INSTALL), client.jetstream()
    try:
        await stream.stream_info(NAME)
    except errors.NotFoundError:
        await _replicated(
            lambda replicas: stream.add_stream(
                name=NAME,
                subjects=[tasks_of("*"), results_of("*")],
                retention=api.RetentionPolicy.WORK_QUEUE,
                max_age=KEPT_S,
                num_replicas=replicas,
            )
        )
        return True
    return False


async def open_consumer(client: Client, name: str, subject: str) -> None:
    """Create a consumer, unless it exists."""
    api, errors, stream = library("nats.js.api", INSTALL), library("nats.js.errors", INSTALL), client.jetstream()
    try:
        await stream.consumer_info(NAME, name)
    except errors.NotFoundError:
        await stream.add_consumer(
            NAME,
            durable_name=name,
            filter_subject=subject,
            ack_policy=api.AckPolicy.EXPLICIT,
            ack_wait=ACK_WAIT_S,
            max_ack_pending=-1,
            inactive_threshold=KEPT_S,
        )


async def open_store(client: Client) -> ObjectStore:
    """Open the store of bundles, and create it if it does not exist."""
    api, errors, stream = library("nats.js.api", INSTALL), library("nats.js.errors", INSTALL), client.jetstream()
    try:
        return await stream.object_store(NAME)
    except errors.NotFoundError:
        return await _replicated(
            lambda replicas: stream.create_object_store(
                NAME, config=api.ObjectStoreConfig(ttl=KEPT_S, replicas=replicas)
            )
        )


async def insist(client: Client, call: Callable[[JetStreamContext], Awaitable[_Result]]) -> _Result:
    """Call JetStream, and try again as long as the server is away.

    Raises:
        RemoteError: The server refuses, or the connection was closed for ever.

    """
    errors, js = library("nats.errors", INSTALL), library("nats.js.errors", INSTALL)
    while True:
        try:
            return await call(client.jetstream())
        except js.ServiceUnavailableError:
            pass
        except js.APIError as error:
            raise RemoteError(f"the NATS server refuses access to {NAME}: {error.description or error}") from None
        except (errors.Error, OSError):  # a time-out is an OSError
            if client.is_closed:
                raise RemoteError("the connection to the NATS server was closed") from None
        await asyncio.sleep(RETRY_S)
