"""From a block's frames to clients' streams: feeds, conflation, back-pressure."""
