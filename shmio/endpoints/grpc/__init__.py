"""The gRPC endpoint.

``wakeups`` wakes the event loop when a block has something new. ``streams.feed`` follows one
block and encodes each change once for all listeners; ``streams.outbox`` queues messages for one
client's stream. ``commands`` sends clients' values to sources, ``topics`` resolves their paths,
and ``time`` steps and plays. ``services`` and ``shmio_v1`` are the services, which ``server``
serves with health and reflection on every listening address.
"""
