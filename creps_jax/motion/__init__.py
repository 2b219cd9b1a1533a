"""Movement primitives, the NAO's geometry and kinematics, and its walk; no learning and no MuJoCo in here."""
