"""The exact Delaunay graph in NumPy and scipy: certified Qhull, exact predicates, dual lengths."""
