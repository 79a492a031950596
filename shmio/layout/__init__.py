"""Layouts: from data-block sources to registers, their values, names and changes. Pure; no I/O."""
