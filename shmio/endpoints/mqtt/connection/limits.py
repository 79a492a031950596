"""The limits that a broker states in its CONNACK (MQTT 5.0, section 3.2.2.3); MQTT 3.1.1 has none."""

from __future__ import annotations

from typing import Final, NamedTuple

from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from shmio.endpoints.mqtt.channel import Message

MOST_IN_FLIGHT: Final = 1000
"""Maximum number of unacknowledged messages."""
FEW_IN_FLIGHT: Final = 4
"""The maximum where commands arrive: as many may be read at once, and each takes time."""
HEAD_BYTES: Final = 128
"""Maximum size of a packet beside topic and payload."""


class Limits(NamedTuple):
    """A broker's limits.

    ``in_flight``: unacknowledged messages; ``packet_bytes``: None: unlimited.
    """

    in_flight: int = MOST_IN_FLIGHT
    packet_bytes: int | None = None
    qos: int = 1
    retain: bool = True
    identifiers: bool = True
    """Whether subscriptions may have an identifier, which the broker adds to their messages."""

    @classmethod
    def from_connack(cls, properties: Properties | None, most: int) -> Limits:
        """Read the limits of a CONNACK.

        ``most``: number of unacknowledged messages that we want.
        """
        given = vars(properties) if properties is not None else {}
        return cls(
            min(most, given.get("ReceiveMaximum", most)),
            given.get("MaximumPacketSize"),
            min(1, given.get("MaximumQoS", 1)),
            bool(given.get("RetainAvailable", 1)),
            bool(given.get("SubscriptionIdentifierAvailable", 1)),
        )

    def fit(self, message: Message) -> bool:
        """Return whether a message is small enough."""
        size = HEAD_BYTES + len(message.topic.encode()) + len(message.payload)
        return self.packet_bytes is None or size <= self.packet_bytes


def subscription(*, retained: bool) -> SubscribeOptions:
    """Make the options of a subscription to what others publish, with its retain flag.

    ``retained``: retained messages are sent, too.
    """
    before = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE if retained else SubscribeOptions.RETAIN_DO_NOT_SEND
    return SubscribeOptions(1, noLocal=True, retainAsPublished=True, retainHandling=before)
