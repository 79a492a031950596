"""Exports an instance as an FMU for co-simulation, and runs the instance for a simulation program.

``archive.py`` writes the FMU, whose library is ``library.c``. The library starts ``process.py`` in a
Python process, which steps a laboratory. ``exchange.py`` has the messages between the two.
"""
