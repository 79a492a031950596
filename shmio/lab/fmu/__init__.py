"""Exports an instance as an FMU for co-simulation, and runs it for a simulation program.

``archive.py`` writes the FMU, whose library is ``library.c``. The library starts ``process.py`` in a
Python process, which steps a laboratory; ``exchange.py`` has their messages.
"""
