"""Judges expectations. Each becomes a formula over signals, and gets a verdict with its robustness."""
