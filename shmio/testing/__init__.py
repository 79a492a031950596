"""Code that tests and benchmarks share, such as a TCP proxy with faults, and the pytest plugin.

It is never imported at run time.
"""
