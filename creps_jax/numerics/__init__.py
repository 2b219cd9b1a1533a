"""Numbers: linear algebra, minimisation, rotations, curves."""
