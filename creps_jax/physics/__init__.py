"""Simulators of robots."""
