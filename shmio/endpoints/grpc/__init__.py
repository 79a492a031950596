"""The gRPC endpoint.

``streams.feed`` follows one block and encodes each change once for all listeners;
``streams.outbox`` queues messages for one client's stream. ``commands`` sends clients' values
to sources, ``injection`` has their injections, and ``time`` steps and plays. ``services`` and
``shmio_v1`` are the services, which ``server`` serves with health and reflection on every
listening address.
"""
