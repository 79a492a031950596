"""The way from a block's frames to clients' streams: feeds, conflation, and back-pressure."""
