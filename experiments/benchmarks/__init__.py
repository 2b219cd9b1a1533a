"""Benchmarks: side by side in one run, since absolute times drift."""
