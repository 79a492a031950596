"""What a broker takes, as it says when it lets us in (MQTT 5.0, section 3.2.2.3); one of version 3.1.1 says nothing."""

from __future__ import annotations

from typing import Final, NamedTuple

from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from shmio.endpoints.mqtt.channel import Message

MOST_IN_FLIGHT: Final = 1000
"""Messages that the broker has not acknowledged."""
FEW_IN_FLIGHT: Final = 4
"""The same where commands come in, of which each takes its time: as many may be read at once."""
HEAD_BYTES: Final = 128
"""Of a packet, beside topic and payload, at most."""


class Limits(NamedTuple):
    """``in_flight``: messages without an acknowledgement; ``packet_bytes``: None for any."""

    in_flight: int = MOST_IN_FLIGHT
    packet_bytes: int | None = None
    qos: int = 1
    retain: bool = True
    identifiers: bool = True
    """Whether a subscription may have a number, which what comes by it tells."""

    @classmethod
    def from_connack(cls, properties: Properties | None, most: int) -> Limits:
        """Those of a CONNACK; ``most``: messages without an acknowledgement that we want."""
        given = vars(properties) if properties is not None else {}
        return cls(
            min(most, given.get("ReceiveMaximum", most)),
            given.get("MaximumPacketSize"),
            min(1, given.get("MaximumQoS", 1)),
            bool(given.get("RetainAvailable", 1)),
            bool(given.get("SubscriptionIdentifierAvailable", 1)),
        )

    def fit(self, message: Message) -> bool:
        """Whether it is not too large."""
        size = HEAD_BYTES + len(message.topic.encode()) + len(message.payload)
        return self.packet_bytes is None or size <= self.packet_bytes


def subscription(*, retained: bool) -> SubscribeOptions:
    """To what others publish, with its flag; ``retained``: also to what was there before."""
    before = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE if retained else SubscribeOptions.RETAIN_DO_NOT_SEND
    return SubscribeOptions(1, noLocal=True, retainAsPublished=True, retainHandling=before)
