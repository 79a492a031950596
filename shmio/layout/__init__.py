"""Layouts: compile data-block sources to registers, and encode and name their values. No I/O."""
