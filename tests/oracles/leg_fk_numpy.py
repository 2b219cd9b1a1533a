"""Compute the NAO's leg forward kinematics in float64 from the simulator's table of bodies.

The table gives, in the simulator's axes (x right, y forward, z up), the centre of each body from the centre
of its parent, the joint's anchor from the centre of the body that it moves, and the joint's axis. No length
derived from it is used.
"""

import numpy as np

# The sole's frame lies under the ankle on the lower face of the foot, a box 0.02 high.
SOLE_FROM_FOOT = np.array([0.0, -0.03, -0.01])
# From the simulator's axes to x forward, y left, z up.
AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def leg_bodies(side):  # +1 left, -1 right
    """Return the rows hip1, hip2, thigh, shank, ankle, foot: (centre, anchor, axis)."""
    tilted = (-np.sqrt(0.5), 0.0, -side * np.sqrt(0.5))
    pitch, roll = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    return (
        ((-side * 0.055, -0.01, -0.115), (0.0, 0.0, 0.0), tilted),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), roll),
        ((0.0, 0.01, -0.04), (0.0, -0.01, 0.04), pitch),
        ((0.0, 0.005, -0.125), (0.0, -0.01, 0.045), pitch),
        ((0.0, -0.01, -0.055), (0.0, 0.0, 0.0), pitch),
        ((0.0, 0.03, -0.04), (0.0, -0.03, 0.035), roll),
    )


def axis_rotation(axis, angle):
    """Return the rotation by `angle` about a unit axis (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def leg_fk(joint_pos, side):
    """Return the pose (4, 4) of the sole in the torso's frame (x forward, y left, z up)."""
    rotation, centre = np.eye(3), np.zeros(3)
    for (offset, anchor, axis), angle in zip(leg_bodies(side), joint_pos, strict=True):
        joint = centre + rotation @ (np.array(offset) + anchor)
        rotation = rotation @ axis_rotation(axis, angle)
        centre = joint - rotation @ anchor
    pose = np.eye(4)
    pose[:3, :3] = AXES @ rotation @ AXES.T
    pose[:3, 3] = AXES @ (centre + rotation @ SOLE_FROM_FOOT)
    return pose
