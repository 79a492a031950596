"""The connector ``modbus``: devices that speak Modbus TCP.

``shmio.layout.addresses.modbus`` parses the addresses of a tag table, ``plan.py`` merges them into
requests, ``client.py`` exchanges the requests, and ``connector.py`` turns the answers into images, and
writes into requests. The protocol is specified in "MODBUS Application Protocol Specification V1.1b3"
and "MODBUS Messaging on TCP/IP Implementation Guide V1.0b".
"""
