"""The robots: lengths, limits and leg kinematics."""
