"""The paths that the server answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from prometheus_client.exposition import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from shmio.endpoints.web.measurements import Measurements
from shmio.endpoints.web.metrics import Exposition, InstanceCollector
from shmio.segment import Segment

_HINT: Final = "shmio: /metrics has the figures of the instance, for Prometheus\n"


def metrics_app(
    segment: Segment, measurements: Measurements, folders: Mapping[str, str], registers: Sequence[str]
) -> Starlette:
    """Return the application of ``[metrics]``, which answers ``/metrics``, and ``/`` with a hint.

    Args:
        segment: The instance's segment.
        measurements: The histograms.
        folders: Folders whose free space is reported, by purpose.
        registers: Patterns of the registers whose values are reported.

    """
    exposition = Exposition(InstanceCollector(segment, measurements, folders, registers))

    async def metrics(_request: Request) -> Response:
        return Response(await run_in_threadpool(exposition.answer), media_type=CONTENT_TYPE_LATEST)

    async def hint(_request: Request) -> Response:
        return PlainTextResponse(_HINT)

    return Starlette(routes=[Route("/metrics", metrics), Route("/", hint)])
