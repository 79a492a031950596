"""Delivers the frames of blocks to clients' streams, with conflation and back-pressure."""
