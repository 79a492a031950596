"""The gRPC endpoint.

- ``wakeups`` wakes the event loop when a block has a new frame or event.
- ``streams.feed`` follows one block, and encodes each change once for all listeners.
- ``streams.outbox`` queues the messages of one stream to a client.
- ``commands`` sends commands with clients' values to the sources.
- ``topics`` resolves clients' paths.
- ``time`` steps and plays virtual time.
- ``services`` and ``shmio_v1`` implement the services. ``server`` serves them on each address, with
  health and reflection.
"""
