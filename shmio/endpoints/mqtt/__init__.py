"""The MQTT endpoint: a bridge to a broker, and our own broker where there is no other.

``feed`` follows one block and marks what changed, ``channel`` makes a topic's payload when its turn comes, ``outbox``
is what waits for the broker, or is kept while it is away, ``link`` the connection to it, ``commands`` and ``inlet``
take values the other way, ``steps`` delivers those of virtual time. ``bridge`` has one thread turn all of them.
"""
