"""The verbs of ``shmio fabric``: all cells of a fabric, and the configuration of its servers."""
