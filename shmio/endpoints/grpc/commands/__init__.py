"""Sends commands to a block's source, returns their outcomes, and passes the source's events on."""
