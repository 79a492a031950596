"""Emulated controllers: processes that act as a PLC with its plant, for demonstrations and tests.

``emulator`` has the S7 controller, and ``s7`` its server. ``modbus`` and ``opcua`` have the devices of
the other kinds. ``programs`` has the programs that a device can run, and ``cycle`` runs them.
"""
