"""Endpoints: what serves the segment to remote programs, a process for each."""
