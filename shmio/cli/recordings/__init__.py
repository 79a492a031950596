"""Verbs of ``shmio-dump``: functions that take the parsed arguments and return the exit status."""
