"""Verbs of ``shmio-supervisor``: functions of the arguments that return the exit status."""
