"""Searches the ranges of a campaign for values with which an expectation fails."""
