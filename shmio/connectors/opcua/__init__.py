"""The connector ``opcua``: reads and writes the nodes of an OPC UA server.

``decode.py`` reads values from messages, ``structures.py`` reads the members of structures by the
definitions that ``data_types.py`` gets from the server, and ``values.py`` converts values to those of
registers. ``trust.py`` checks certificates, ``session.py`` runs one session with its subscriptions,
``connector.py`` runs all sessions in a thread, and ``browse.py`` lists what a server offers.
``shmio.layout.addresses`` parses the addresses. Section numbers refer to OPC 10000.
"""
