"""The client that sends messages in batches, without a connection."""

from __future__ import annotations

from paho.mqtt.enums import CallbackAPIVersion

from shmio.endpoints.mqtt.connection.broker_client import BrokerClient


def test_a_packet_identifier_that_is_in_use_is_passed_over() -> None:
    """A message may be unacknowledged while 65,535 others follow it (MQTT 5.0, section 2.2.1)."""
    client = BrokerClient(CallbackAPIVersion.VERSION2)
    used = {2, 3, 65_535}
    found = [client.queue_message("t", b"", 1, None, retain=False, unacknowledged=used) for _ in range(65_533)]
    assert found == [1, *range(4, 65_535), 1]
