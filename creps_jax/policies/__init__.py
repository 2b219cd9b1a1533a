"""Policies: distributions of parameters that depend on a context."""
