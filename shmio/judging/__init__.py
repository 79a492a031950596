"""Judges expectations: formulas over signals, their verdicts and their robustness."""
