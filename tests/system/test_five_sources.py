"""examples/five-sources: each peer is killed and frozen once; only its own source notices, and recovers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shmio.testing.cell import until
from shmio.testing.mosquitto import missing
from tests.faults.five_sources import FAULTS, run, started

pytest.importorskip("asyncua")
pytest.importorskip("cyclonedds")
pytest.importorskip("pymodbus")

COMMANDS = {"press/Lamp": True, "furnace/Setpoint": 900.0, "conveyor/Start": True, "sensors/Lamp": True}


@pytest.mark.timeout(600)  # twelve faults, each with a wait of at least half a second, on a host that may be busy
@pytest.mark.skipif(bool(missing()), reason=missing())
def test_a_fault_of_a_peer_reaches_its_own_source_only(tmp_path: Path, instance: str) -> None:
    with started(tmp_path, instance) as example:
        example.calm()
        for path, value in {**COMMANDS, "arm/Override": 3.0}.items():
            example.cell.output("shmio", "set", path, json.dumps(value))

        def commanded() -> bool:
            found = json.loads(example.cell.output("shmio", "get", "--json", *COMMANDS))
            return {path: one["value"] for path, one in found.items()} == COMMANDS

        until(commanded, "every device has done what it was told")
        results = run(example, rounds=1, seed=1, say=print)
        assert len(results) == len(FAULTS) * len(example.peers)
        for result in results:
            assert len(result.bad_ms) == len(result.good_ms) == 1, result
            assert result.others_frames > 0, result
            assert result.others_bad == 0, result
        processes = example.cell.processes()
        assert {name: processes[name]["restarts"] for name in example.watchers} == dict.fromkeys(example.watchers, 0)
