"""Endpoints: the processes that serve the segment to remote programs."""
