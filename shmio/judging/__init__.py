"""What expectations mean: formulas over signals, their verdicts and robustness."""
