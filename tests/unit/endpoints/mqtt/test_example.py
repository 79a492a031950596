"""``examples/mqtt.py``: its messages when nothing arrives."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from shmio.config import Address
from shmio.testing.mosquitto import Mosquitto
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.mqtt.harness import PREFIX, TIMEOUT_S, listening

EXAMPLE = Path(__file__).parents[4] / "examples/mqtt.py"
PATH = "cell/Robot_800/Axs1_Pos"


def command(address: Address, *words: str) -> list[str]:
    return [sys.executable, str(EXAMPLE), str(address), PREFIX, *words]


def fails(address: Address, *words: str) -> str:
    """Run the example, which must fail. Return the line that it prints."""
    done = subprocess.run(command(address, *words), capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.stderr
    return done.stderr


def test_an_address_without_a_broker_is_reported() -> None:
    with reserved_port() as address:
        told = fails(address, PATH)
    assert told == f"{address}: Connection refused; shmio-supervisor status says whether the broker runs\n"


def test_a_topic_without_messages_is_named(broker: Mosquitto) -> None:
    told = fails(broker.address, "--count", "1", "--timeout", "0.2", "cell/Nope")
    assert told == f"received 0 messages in 0.2 s on {PREFIX}/cell/Nope/out; shmio list names the registers\n"
    told = fails(broker.address, "--timeout", "0.2", "--write", "cell/Nope=1")
    assert told == f"received 0 messages in 0.2 s on {PREFIX}/cell/Nope/in/result; shmio list names the registers\n"


def test_a_killed_broker_is_reported(broker: Mosquitto) -> None:
    with listening(broker.address) as listener:
        listener.publish(f"{PATH}/out", "1.5", retain=True)
    done = subprocess.run(
        command(broker.address, "--count", "1", PATH), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{PATH}/out 1.5\n", "")
    with subprocess.Popen(
        command(broker.address, PATH), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        assert running.stdout.readline() == f"{PATH}/out 1.5\n"
        broker.kill()
        _, error = running.communicate(timeout=TIMEOUT_S)
    assert running.returncode == 1
    assert error == (
        f"{broker.address}: the broker has closed the connection; shmio-supervisor status shows its state\n"
    )


def test_a_broker_that_needs_an_account_is_reported(make_broker: Callable[..., Mosquitto]) -> None:
    broker = make_broker("allow_anonymous false")
    assert fails(broker.address, PATH) == f"{broker.address}: the broker refuses this client: Not authorized\n"
