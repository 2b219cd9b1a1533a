"""The robots: lengths, limits and leg kinematics, also read from MuJoCo models."""
