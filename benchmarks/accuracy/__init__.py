"""How right scores and verdicts are, against ground truth."""
