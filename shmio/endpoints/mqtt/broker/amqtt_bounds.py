"""aMQTT's broker, with bounds for what its clients can have it keep."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterator
from functools import partial
from typing import Any, Final

from amqtt.broker import Action, Broker
from amqtt.session import Session

from shmio.endpoints.mqtt.broker.access import Guest
from shmio.endpoints.mqtt.broker.amqtt_shares import Bound, Exchanges, Refusals, Retained, Waiting
from shmio.endpoints.mqtt.broker.amqtt_streams import PEER, Reader, Writer
from shmio.layout.values.checks import brief

MAX_UNHANDLED: Final = 64
"""Messages of all that are being handed on."""
MAX_KEPT: Final = 1000
"""Messages for one client's session while it is away; as mosquitto, it is given the oldest."""
KEPT: Final = Bound(8 << 20, 64 << 20)
MAX_AWAY: Final = 256
"""Sessions that are kept while their clients are away."""
UNFINISHED: Final = Bound(8 << 20, 64 << 20)
"""Of messages of QoS 2 that their clients do not release."""
RETAINED: Final = Bound(8 << 20, 64 << 20)
SUBSCRIBED_BYTES: Final = 256 << 10
"""Of one client's subscriptions."""
FILTER_BYTES: Final = 300
"""Of a subscription, about, beside its topics."""
NEVER_RELEASED: Final = (
    "client %s leaves too many messages of QoS 2 unfinished: its connection is ended; have it answer PUBREC with PUBREL"
)
NOT_RETAINED: Final = (
    "client %s: what it publishes is handed on, and not retained, for too much is; have it retain less"
)
NOT_SUBSCRIBED: Final = "client %s: a subscription is refused, for it has too many; have it use wildcards"
NOT_KEPT: Final = (
    "client %s: its session is not kept while it is away, for too many are; have it connect with a clean session"
)
NOT_ALLOWED: Final = "client %s publishes where it may not: give its account the role write, or topics (mqtt.account)"
OTHERS: Final = "client %s is refused: a client of another account is called so; give each one a name of its own"
GUEST: Final = "shmio.guest"
_REFUSED: Final = 0x80
"""Of a SUBACK."""


class Hub(Broker):  # type: ignore[misc]  # the library's classes have no types
    """Sends a client what is retained for its own subscriptions alone; aMQTT sends who connects that of everybody's.

    What it has read and not handed on is bounded: who publishes faster than that goes is slowed down by TCP.
    """

    def __init__(self, config: dict[str, Any], refusals: Refusals) -> None:
        super().__init__(config)
        self._broadcast_queue: asyncio.Queue[Any] = asyncio.Queue(MAX_UNHANDLED)
        self._subscriptions: dict[str, list[tuple[Session, int]]] = _Subscriptions()
        self._subscribed: Counter[str] = Counter()
        """Bytes, by client."""
        self._owners = Retained(RETAINED)
        self._refusals = refusals

    # ---- one client's connection -------------------------------------------------------------------------------------

    async def _handle_client_session(
        self, reader: Reader, writer: Writer, client_session: Session, handler: Any, *rest: Any
    ) -> None:
        if not isinstance(client_session.inflight_in, Exchanges):  # else it is one from before
            client_session.inflight_in = Exchanges()
            client_session.delivered_message_queue, client_session.retained_messages = Waiting(), Waiting()
        client_session.inflight_in.connected()
        client_session.attributes[GUEST] = reader.guest
        handler._pending_subscriptions, handler._pending_unsubscriptions = Waiting(), Waiting()
        reader.client = writer.client = _name(client_session)
        if client_session.will_flag and not self._may_publish(client_session, client_session.will_topic):
            client_session.will_flag = False
        reader.on_packet = partial(_count, client_session.inflight_in)
        reader.admit = partial(self._admit, reader, client_session, handler)
        try:
            await super()._handle_client_session(reader, writer, client_session, handler, *rest)
        finally:
            await self._leave(client_session, handler)

    async def _admit(self, reader: Reader, session: Session, handler: Any) -> None:
        """Wait until there is room for more of a client. OSError: there will be none."""
        if UNFINISHED.broken(session.inflight_in.bytes, self._unfinished):
            reader.end(NEVER_RELEASED)
        await session.delivered_message_queue.room()
        await handler._pending_subscriptions.room()
        await handler._pending_unsubscriptions.room()

    def _unfinished(self) -> Iterator[int]:
        return (session.inflight_in.bytes for session, _ in self._sessions.values())

    async def _leave(self, session: Session, handler: Any) -> None:
        """Its connection is over: keep the session, if it is to be kept, and there is room, and something in it."""
        name = session.client_id
        if self._sessions.get(name, (None, None))[1] is not handler:  # another connection has it
            return
        if session.transitions.state == "connected":  # the library forgets who broke a rule
            await self._stop_handler(handler)
            session.transitions.disconnect()
        if session.clean_session:
            return  # the library will see to it
        away = [one for one, _ in self._sessions.values() if one.transitions.state == "disconnected"]
        if not self._subscribed[name] and not session.inflight_in:
            await self._delete_session(name)
        elif sum(not one.clean_session for one in away) > MAX_AWAY:
            self._refusals.tell(NOT_KEPT, _name(session))
            await self._delete_session(name)

    # ---- who may do what ---------------------------------------------------------------------------------------------

    def lets(self, guest: Guest) -> bool:
        """Whether who connects may have the client id that he shows: it is nobody's of another account."""
        session = self._sessions.get(guest.client_id, (None, None))[0]
        if session is None or session.attributes[GUEST].account == guest.account:
            return True
        self._refusals.tell(OTHERS, brief(guest.client_id))
        return False

    async def _topic_filtering(self, session: Session, topic: str, action: Action) -> bool:
        if action is Action.PUBLISH:
            return self._may_publish(session, topic)
        allowed: bool = session.attributes[GUEST].rights.read
        return allowed

    def _may_publish(self, session: Session, topic: str) -> bool:
        allowed: bool = session.attributes[GUEST].rights.may_publish(topic)
        if not allowed:
            self._refusals.tell(NOT_ALLOWED, _name(session))
        return allowed

    async def _delete_session(self, client_id: str) -> None:
        session, handler = self._sessions.get(client_id, (None, None))
        await super()._delete_session(client_id)
        if session is not None and session.transitions.state == "connected":  # the library would leave it there, deaf
            await handler.handle_connection_closed()

    # ---- what is kept for clients ------------------------------------------------------------------------------------

    async def _retain_broadcast_message(self, broadcast: dict[str, Any], qos: int, target_session: Session) -> None:
        kept = target_session.retained_messages
        if kept.qsize() < MAX_KEPT and not KEPT.broken(kept.bytes, self._kept):
            await super()._retain_broadcast_message(broadcast | {"session": None}, qos, target_session)

    def _kept(self) -> Iterator[int]:
        return (session.retained_messages.bytes for session, _ in self._sessions.values())

    async def retain_message(
        self, source_session: Session | None, topic_name: str, data: bytes | None, qos: int | None = None
    ) -> None:
        """Retain it, if there is room; what was retained there before is not so any more in any case."""
        self._owners.forget(topic_name)
        if data and source_session is not None and not self._has_room(source_session, topic_name, len(data)):
            self._refusals.tell(NOT_RETAINED, _name(source_session))
            data = None
        await super().retain_message(None, topic_name, data, qos)  # who it was would be kept as long as the topic

    def _has_room(self, session: Session, topic: str, size: int) -> bool:
        return session.remote_address == PEER or self._owners.keep(topic, session.client_id, size)

    # ---- subscriptions -----------------------------------------------------------------------------------------------

    async def add_subscription(self, subscription: tuple[str, int], session: Session) -> int:
        """The code for the SUBACK."""
        topics = subscription[0]
        size = 0 if self._has(session, topics) else FILTER_BYTES + len(topics)
        if self._subscribed[session.client_id] + size > SUBSCRIBED_BYTES:
            self._refusals.tell(NOT_SUBSCRIBED, _name(session))
            return _REFUSED
        code: int = await super().add_subscription(subscription, session)
        if code != _REFUSED:
            self._subscribed[session.client_id] += size
        return code

    def _has(self, session: Session, topics: str) -> bool:
        return any(whose.client_id == session.client_id for whose, _ in self._subscriptions.get(topics, ()))

    def _del_subscription(self, a_filter: str, session: Session) -> int:
        deleted: int = super()._del_subscription(a_filter, session)
        if deleted:
            self._subscribed[session.client_id] -= FILTER_BYTES + len(a_filter)
            if not self._subscribed[session.client_id]:
                del self._subscribed[session.client_id]
        return deleted

    async def _handle_unsubscription(self, client_session: Session, handler: Any, unsubscribe_waiter: Any) -> None:
        await super()._handle_unsubscription(client_session, handler, unsubscribe_waiter)
        for topics in unsubscribe_waiter.result().topics:
            if not self._subscriptions.get(topics, True):  # the library leaves them there for ever
                del self._subscriptions[topics]

    async def _publish_retained_messages_for_subscription(
        self, subscription: tuple[str, int], session: Session
    ) -> None:
        if self._has(session, subscription[0]):
            await super()._publish_retained_messages_for_subscription(subscription, session)


class _Subscriptions(dict[str, list[tuple[Session, int]]]):
    """By topics; they may come and go while the library goes through them."""

    def __iter__(self) -> Iterator[str]:
        return iter(list(super().__iter__()))


def _count(exchanges: Exchanges) -> None:
    exchanges.packets += 1


def _name(session: Session) -> str:
    """For people; it is the client's own choice, so anything may be in it."""
    return f"{brief(session.client_id)} at {session.remote_address}:{session.remote_port}"
