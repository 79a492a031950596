"""Reads recordings that are closed, were left by a killed recorder, or are being written."""
