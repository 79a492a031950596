"""Verbs of ``shmio-supervisor``: functions that take the parsed arguments and return the exit status."""
