"""Run, plot and check the experiments: one file a figure or table, and what they share."""
