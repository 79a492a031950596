"""Delivers blocks' frames to clients' streams: feeds, conflation, and back-pressure."""
