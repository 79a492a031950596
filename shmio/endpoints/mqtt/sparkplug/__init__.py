"""Sparkplug B (Eclipse Sparkplug Specification 3.0.0): the instance as an edge node, its sources as devices."""
