"""Send requests to the supervisor of a local instance."""

from __future__ import annotations

from typing import Any

from shmio import control
from shmio.errors import ControlError, UnreachableError
from shmio.local.status import supervisor_silence
from shmio.segment import Segment


def ask_supervisor(segment: Segment, request: control.Request, timeout_s: float) -> dict[str, Any]:
    """Send a request to the supervisor of a segment's instance, and return its answer.

    ``timeout_s`` is the longest time to wait for the answer, in s.

    Raises:
        ControlError: The supervisor refuses, does not answer, or seems to be dead.

    """
    try:
        return control.request(segment.header.control, request, timeout_s, lambda: supervisor_silence(segment))
    except UnreachableError as error:
        remedy = (
            f"kill -TERM {segment.supervisor[0]} stops the instance"
            if segment.supervised
            else f"the supervisor is dead; shmio-supervisor down --instance {segment.instance} stops what it left"
        )
        raise ControlError(f"{error}; {remedy}") from None
