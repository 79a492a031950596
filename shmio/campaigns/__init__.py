"""Runs campaigns on an instance, and judges what they expect."""
