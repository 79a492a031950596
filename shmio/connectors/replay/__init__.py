"""``connector = "replay"``: a recording takes the place of what it was made of (docs/how-to/replay-a-recording.md)."""
