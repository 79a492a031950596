"""Verbs of ``shmio-supervisor``: functions that take the arguments and return the exit status."""
