"""Writes the histories of the cells of a fabric to Parquet files, each frame once.

``service`` reads the streams, ``cell_files`` writes the files of one cell, and ``numbers`` knows
which messages were written.
"""
