"""The verbs of ``shmio-campaign``."""
