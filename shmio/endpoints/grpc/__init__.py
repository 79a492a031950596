"""The gRPC endpoint.

``feed`` follows one block and encodes each change once for all who listen to it; ``outbox`` is what waits for one
client's stream; ``publish`` takes values the other way. ``simlog_v1`` and ``simlog_v2`` are the wires, ``services`` has
all of them, and ``server`` puts them, health and reflection on every listening address.
"""
