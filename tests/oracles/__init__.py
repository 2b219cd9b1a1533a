"""Independent references for the tests: plain NumPy and SciPy in float64, written for clarity."""
