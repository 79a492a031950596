"""Sparkplug B (Eclipse Sparkplug Specification 3.0.0).

The instance is an edge node, and its sources are devices.
"""
