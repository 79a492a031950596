"""Searches the ranges of a campaign for values at which an expectation fails."""
