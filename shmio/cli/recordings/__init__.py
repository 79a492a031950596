"""Verbs of ``shmio-dump``: functions of the arguments that return the exit status."""
