"""Scores of putative matches beside the paper's verdict: consensus without weights, and a learned one."""
