"""Code that tests and benchmarks share, such as a TCP proxy with faults.

It is never imported at run time.
"""
