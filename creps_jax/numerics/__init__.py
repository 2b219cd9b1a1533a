"""Numerics: linear algebra, minimisation, rotations, curves."""
