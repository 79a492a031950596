"""``connector = "replay"``: plays a recording (docs/how-to/replay-a-recording.md)."""
