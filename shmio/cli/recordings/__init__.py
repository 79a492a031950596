"""Verbs of ``shmio-dump``: functions that take the arguments and return the exit status."""
