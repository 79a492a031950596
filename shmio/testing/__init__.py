"""Code that tests and benchmarks share, such as a TCP proxy with faults, and the pytest plugin.

A running instance never imports this package.
"""
