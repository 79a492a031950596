"""Reads recordings, whether they are closed, are still being written, or were left by a killed recorder."""
