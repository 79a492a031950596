"""Sends commands to a block's source, returns their outcomes, and passes on the source's events."""
