"""Time and memory, ours and the peers' in the same run."""
