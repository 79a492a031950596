"""Runs campaigns on an instance, and judges whether their expectations are met."""
