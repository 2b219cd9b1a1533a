"""Set-points follow their targets as fast as the joints can turn."""

import jax
import numpy as np

from creps_jax.robots.nao_geometry import MAX_JOINT_SPEED, NUM_JOINTS
from creps_jax.walking.set_points import next_set_point

PERIOD = 0.02


def test_a_set_point_reaches_its_target_or_comes_as_near_as_it_can():
    start, target = np.zeros(NUM_JOINTS, np.float32), np.linspace(-0.3, 0.3, NUM_JOINTS, dtype=np.float32)
    reached = np.asarray(jax.jit(next_set_point, static_argnums=2)(start, target, PERIOD))
    is_near = np.abs(target) <= MAX_JOINT_SPEED * PERIOD
    np.testing.assert_array_equal(reached[is_near], target[is_near])
    np.testing.assert_allclose(np.abs(reached[~is_near]), MAX_JOINT_SPEED * PERIOD, rtol=1e-6)
    assert 0 < is_near.sum() < NUM_JOINTS
