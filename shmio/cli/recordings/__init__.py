"""The verbs of ``shmio-dump``; each module has ``execute``."""
