"""The connector ``opcua``: reads and writes the nodes of an OPC UA server.

``address.py`` reads the addresses of a tag table, ``siemens.py`` derives those of a data block of an
S7-1500, ``decode.py`` reads values from messages, and ``values.py`` fits them to registers.
``trust.py`` decides about certificates, ``session.py`` has one session with its subscriptions,
``connector.py`` runs the sessions in a thread, and ``browse.py`` lists what a server offers. The
section numbers are those of OPC 10000.
"""
