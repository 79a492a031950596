"""Emulated controllers: processes that act as a PLC with its plant, for demonstrations and tests.

``s7`` is the server; ``programs`` has the programs that an emulated controller can run;
``emulator`` combines a server and a program.
"""
