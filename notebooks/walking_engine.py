# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The walking engine
#
# Ten parameters define a walk. The engine computes joint angles from them in five stages: footsteps, zero
# moment point (ZMP), centre of mass (CoM), swing foot, joints. This notebook shows the planned motion,
# without physics.

# %%
import sys
from pathlib import Path

ROOT = next(folder for folder in (Path.cwd(), *Path.cwd().parents) if (folder / "pyproject.toml").exists())
sys.path.insert(0, str(ROOT))

from creps_jax.tools.process import prepare

prepare()  # Keep compiled programs in a cache, so that the next run starts faster.

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import creps_jax as cj
from creps_jax.robots.nao_geometry import JOINT_LOWER, JOINT_NAMES, JOINT_UPPER
from creps_jax.tools.plots import COLOURS
from creps_jax.walking.com import zmp_of_com
from creps_jax.walking.com_plan import NUM_NODES, com_heights
from creps_jax.walking.engine import pose_joints
from creps_jax.walking.gaits import AHEAD, straight_walker
from creps_jax.walking.open_loop import open_loop_walk
from creps_jax.walking.params import PARAM_NAMES, PARAM_UNITS, params_from_theta
from creps_jax.walking.zmp import zmp_reference

# %%
theta = cj.load(ROOT / "models" / "nao" / "policies" / "walk.npz").theta(0.3)
print("Parameters of the shipped policy for 0.3 m/s:")
for name, value, unit in zip(PARAM_NAMES, theta, PARAM_UNITS, strict=True):
    print(f"    {name:15} {value:6.3f} {unit}")

# %% [markdown]
# The next cell compiles eight steps as one function of the ten parameters. `straight_walker` makes the
# walker of these parameters, and `open_loop_walk` returns its state in each control period. A state holds
# the plan of its step, from the footsteps to the CoM, in the frame of the start of the step, `origin`. The
# cell takes a state from each step and moves its time through the step: `pose` computes hips and feet, and
# `pose_joints` the joint angles. A plan does not hold the ZMP. The cell therefore computes the ZMP reference
# again, and also the ZMP of the planned CoM.

# %%
NUM_STEPS, PER_STEP = 8, 50
LONGEST = 0.4  # The longest duration of a step in this notebook, s.


def zmps(state):
    params, plan = state.gait.params, state.plan
    phase, share = jnp.linspace(0, 1, NUM_NODES), params.double_support / params.step_duration
    asked = zmp_reference(phase, plan.com[0], plan.footstep.support[:2], plan.com[-1], share)
    real = [zmp_of_com(axis, *com_heights(params), params.step_duration) for axis in plan.com.T]
    return asked, jnp.stack(real, axis=1)


@jax.jit
def engine(theta):
    params, walker = params_from_theta(theta), straight_walker(theta)
    num_periods = round(NUM_STEPS * LONGEST / walker.period)
    states = open_loop_walk(walker, jnp.tile(jnp.array(AHEAD), (num_periods, 1)))
    middles = (jnp.arange(NUM_STEPS) + 0.5) * params.step_duration / walker.period
    steps = jax.tree.map(lambda leaf: leaf[middles.astype(int)], states)

    # The walk is straight: the frames of its steps are moved, and not turned.
    in_steps = (steps.plan.footstep.support[:, None, :2], steps.plan.com, *jax.vmap(zmps)(steps))
    planned = [points + steps.origin[:, None, :2] for points in in_steps]

    ticks = jnp.arange(NUM_STEPS * PER_STEP)
    states = jax.tree.map(lambda leaf: leaf[ticks // PER_STEP], steps)
    phase = ticks % PER_STEP / PER_STEP
    poses = jax.vmap(walker.pose)(states._replace(time=phase * params.step_duration))
    upright = jnp.stack([0.0, params.lean, 0.0])
    joints = jax.vmap(lambda pose: pose_joints(params, pose, upright))(poses)
    return params, planned, ticks * params.step_duration / PER_STEP, poses, joints


params, (support, com, asked, real), times, poses, joints = jax.tree.map(np.asarray, engine(theta))

# %% [markdown]
# ## From footsteps to the centre of mass
#
# The ZMP is the point where the force of the floor acts. It must stay under the standing foot. It moves
# quickly from foot to foot, but the CoM cannot. The CoM sways between the feet so that its acceleration
# gives the ZMP of the reference. This is a tridiagonal linear system for the positions of the CoM. The
# dots are a check: the ZMP of the solved CoM equals the reference.

# %%
figure, (above, sideways) = plt.subplots(1, 2, figsize=(14, 3.4), width_ratios=(3, 2))
outline = np.array([[-0.05, 0.11, 0.11, -0.05], [-0.04, -0.04, 0.04, 0.04]]) - [[0.02], [0.0]]
for place in support[:, 0]:
    above.fill(*(outline + place[:, None]), color=COLOURS[3 if place[1] > 0 else 4], alpha=0.2)
above.plot(*asked.reshape(-1, 2).T, color=COLOURS[1])
above.plot(*com.reshape(-1, 2).T, color=COLOURS[0])
above.set(xlabel="forward (m)", ylabel="left (m)", title="Eight steps from above", aspect="equal")

steps = np.arange(NUM_STEPS)[:, None] + np.linspace(0, 1, NUM_NODES)
clock = params.step_duration * steps
sideways.plot(clock[:4].ravel(), asked[:4, :, 1].ravel(), color=COLOURS[1], label="ZMP reference")
sideways.plot(clock[:4, 1:-1].ravel(), real[:4, :, 1].ravel(), "k.", markersize=3, label="ZMP of the CoM")
sideways.plot(clock[:4].ravel(), com[:4, :, 1].ravel(), color=COLOURS[0], label="CoM")
sideways.set(xlabel="time (s)", ylabel="left (m)", title="Sideways", ylim=(-0.065, 0.1))
sideways.legend(loc="upper center", ncols=3, fontsize=8)
plt.show()

# %% [markdown]
# ## From hips and feet to joints
#
# The hips follow the CoM. The swing foot follows a Bezier curve. Inverse kinematics gives the joint
# angles. The figure shows the robot with these angles, four times in each step; its right side is dark.
# Here MuJoCo only computes the positions of the bodies.

# %%
model = mujoco.MjModel.from_xml_path(str(ROOT / "models" / "nao" / "nao.xml"))
data = mujoco.MjData(model)


names = [model.geom(geom).name for geom in range(model.ngeom)]
toes, heels = ([i for i, name in enumerate(names) if f"_sole_{end}_" in name] for end in ("front", "back"))


def sketch(panel, hips, angles, aside):
    data.qpos[:7] = 0, 0, 0, np.cos(params.lean / 2), 0, np.sin(params.lean / 2), 0
    data.qpos[7:] = angles
    mujoco.mj_kinematics(model, data)
    ankle, toe, heel = data.xpos[model.geom_bodyid[toes]], data.geom_xpos[toes], data.geom_xpos[heels]
    begins = np.concatenate([data.xpos[model.body_parentid[2:]], ankle, toe, heel])
    ends = np.concatenate([data.xpos[2:], toe, heel, ankle])
    shift = hips[:3] - data.body("left_hip1").xpos + [aside, 0, 0]
    x, _, z = np.moveaxis(np.stack([begins, ends]) + shift, 2, 0)
    is_left = ends[:, 1] > 0.01
    for chosen, alpha in ((is_left, 0.3), (~is_left, 1.0)):
        panel.plot(x[:, chosen], z[:, chosen], color=COLOURS[0], alpha=alpha, solid_capstyle="round")
    head = data.body("head").xpos + shift
    panel.plot(head[0], head[2], "o", color=COLOURS[0], markersize=14)


figure, panel = plt.subplots(figsize=(13, 3.4))
for count, index in enumerate(range(250, 351, 12)):
    sketch(panel, poses.hips[index], joints[index], 0.22 * count)
panel.axhline(0, color="black", linewidth=0.8)
panel.set(ylabel="height (m)", title="Two steps; postures are moved apart", aspect="equal", xticks=[])
plt.show()

# %% [markdown]
# The next figure compares the angles with the limits of the joints (dotted lines). Only the ankle pitch
# reaches its limit: because the knees are strongly bent, it stops at 75 degrees in the middle of each
# swing, and the toe of the swing foot points slightly down.

# %%
figure, axes = plt.subplots(2, 3, figsize=(12, 5), sharex=True)
leg = ("hip_yaw_pitch", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
for panel, joint in zip(axes.flat, leg, strict=True):
    for side, colour in (("left", COLOURS[3]), ("right", COLOURS[4])):
        index = JOINT_NAMES.index(f"{side}_{joint}")
        panel.plot(times, np.degrees(joints[:, index]), color=colour, label=side)
        for limit in (JOINT_LOWER[index], JOINT_UPPER[index]):
            panel.axhline(np.degrees(limit), color=colour, linestyle=":", linewidth=1.2)
    panel.set_title(joint.replace("_", " ") + " (deg)")
for panel in axes[1]:
    panel.set_xlabel("time (s)")
axes[0, 0].legend(loc="center right")
plt.show()

# %% [markdown]
# ## The effect of single parameters
#
# Each figure varies one parameter over three values. All other parameters stay the same.

# %%
figure, (sway, zmp, foot) = plt.subplots(1, 3, figsize=(14, 3.6))


def vary(name, values):
    for value, colour in zip(values, COLOURS, strict=False):
        changed = np.where(np.array(PARAM_NAMES) == name, np.float32(value), theta)
        yield {"color": colour, "label": f"{value:g}"}, jax.tree.map(np.asarray, engine(changed))


for style, (_, (_, com, _, _), *_) in vary("step_duration", (0.2, 0.3, 0.4)):
    sway.plot(steps[:2].ravel(), com[4:6, :, 1].ravel(), **style)
for style, (_, (_, _, asked, _), *_) in vary("double_support", (0.0, 0.05, 0.1)):
    zmp.plot(steps[:2].ravel(), asked[4:6, :, 1].ravel(), **style)
for style, (*_, poses, _) in vary("swing_height", (0.02, 0.04, 0.06)):
    foot.plot(poses.left[250:301, 0], poses.left[250:301, 2], **style)
sway.set(xlabel="time (steps)", ylabel="CoM, left (m)", title="Slow steps sway more")
sway.legend(title="step_duration (s)")
zmp.set(xlabel="time (steps)", ylabel="ZMP, left (m)", title="More double support: a slower shift")
zmp.legend(title="double_support (s)")
foot.set(xlabel="forward (m)", ylabel="left sole, up (m)", title="Path of the swing foot", ylim=(0, 0.1))
foot.legend(title="swing_height (m)", ncols=3)
plt.show()
