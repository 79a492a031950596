"""Emulated controllers: processes that play a PLC and its plant, for demonstrations and tests.

``s7`` is the server; ``programs`` has the programs that an emulated controller can run;
``emulator`` combines a server and a program.
"""
