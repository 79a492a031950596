"""Layouts: compile data-block sources, find registers by path, and convert values. No I/O."""
