"""Settings and learning of the walks, for the experiments `walk`, `walk_slope` and `fig11_walk`."""
