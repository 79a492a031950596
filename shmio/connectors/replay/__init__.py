"""The replay connector plays a recording (docs/how-to/replay-a-recording.md)."""
