"""The fabric connector mirrors a source of another cell (docs/how-to/join-hosts.md).

``source.py`` has its keys and finds its layout, ``link.py`` is the connection, ``order.py`` puts
messages into order, ``loop.py`` publishes what they contain, and ``injections.py`` has the owner carry
out injections.
"""
