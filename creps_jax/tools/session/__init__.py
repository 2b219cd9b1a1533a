"""Learn on a real robot, trial by trial: a search that is kept in a folder, which is always consistent.

jax starts only when it is needed: to tell a reward takes no jax, unless the trial completes a batch.
"""

from creps_jax.tools.session.robot_session import RobotSession, Status, Told
from creps_jax.tools.session.trials import Trial

__all__ = ["RobotSession", "Status", "Told", "Trial"]
