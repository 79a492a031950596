"""There are no more connections than the process has descriptors for."""

from __future__ import annotations

import resource

import pytest

from shmio.endpoints.grpc.server.file_descriptors import EACH, FEW, OWN, room, shortage

INFINITE = resource.RLIM_INFINITY


@pytest.mark.parametrize(
    ("soft", "hard", "connections", "after"),
    [
        (20_000, 20_000, 2048, 20_000),
        (1024, 20_000, 2048, OWN + EACH * 2048),
        (1024, INFINITE, 2048, OWN + EACH * 2048),
        (1024, 1024, (1024 - OWN) // EACH, 1024),
        (1024, 2048, (2048 - OWN) // EACH, 2048),
        (INFINITE, INFINITE, 2048, INFINITE),
        (64, 64, 1, 64),
    ],
)
def test_the_limit_is_raised_as_far_as_it_may_be(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, connections: int, after: int
) -> None:
    limits = [soft, hard]
    monkeypatch.setattr(resource, "getrlimit", lambda _: tuple(limits))
    monkeypatch.setattr(resource, "setrlimit", lambda _, new: limits.__setitem__(slice(None), new))
    assert room(2048) == connections
    assert limits == [after, hard]


def test_so_few_connections_that_programs_are_turned_away_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (64, 64))
    told = shortage(1, 2048)
    assert told.startswith(
        "it serves at most 1 connections at once, not 2048: the hard limit of open files is 64; raise"
    )
    assert shortage(FEW, 2048) == ""
    assert shortage(2, 2) == ""
