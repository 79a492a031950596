"""The table of roles lists exactly the calls that the endpoint serves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pool
from grpc_health.v1 import health_pb2
from grpc_reflection.v1alpha import reflection_pb2

from shmio.config.model import ROLES
from shmio.endpoints.grpc.server.access import NEEDS
from shmio.segment import Segment
from tests.unit.endpoints.harness import Endpoint, serve

PAGE = Path(__file__).parents[5] / "docs/reference/grpc-access.md"


def calls(service: Any) -> set[str]:
    return {f"/{service.full_name}/{method.name}" for method in service.methods}


def test_every_call_that_is_served_has_its_role(segment: Segment) -> None:
    pool: Any = descriptor_pool.Default()
    names: list[str] = []

    async def test(served: Endpoint) -> None:
        names.extend(served.service.calls)

    serve(segment, test)
    own = set().union(*(calls(pool.FindServiceByName(name)) for name in names))
    assert own <= set(NEEDS), (
        f"refused, as they are missing in shmio/endpoints/grpc/server/access.py: {sorted(own - set(NEEDS))}"
    )
    for module in (health_pb2, reflection_pb2):
        (service,) = module.DESCRIPTOR.services_by_name.values()
        assert calls(service) <= set(NEEDS)
    assert set(NEEDS.values()) == set(ROLES)


@pytest.mark.parametrize("role", ROLES)
def test_the_page_lists_the_calls_of_each_role(role: str) -> None:
    (line,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| `{role}` |")]
    for method, needed in NEEDS.items():
        name = method.rpartition("/")[2]
        if needed == role:
            assert f"`{name}`" in line, f"{method} is not on the page"
