"""One control step of a robot, by MJX or by C MuJoCo."""
