"""The gRPC endpoint.

``feed`` follows one block and encodes each change once; ``simlog_v1`` shares those bytes among its streams; ``server``
puts services, health and reflection on every listening address.
"""
