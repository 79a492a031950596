"""Emulated controllers: processes that play a PLC and its plant, for demonstrations and tests.

``s7`` is the server, ``s7_jobs`` what it answers; ``programs`` names what an emulated controller can run, one
module each; ``emulator`` puts a server and a program together.
"""
