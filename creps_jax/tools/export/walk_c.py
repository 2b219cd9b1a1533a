"""Write a whole walk as C: policy, planner, kinematics and feedback, for robots without Python."""

import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from creps_jax.errors import UserError
from creps_jax.files import package_version, save_text
from creps_jax.policies.bounds import SIGMOID
from creps_jax.policies.learned import Learned
from creps_jax.robots import legs, screw_kinematics
from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.nao_kinematics import leg_links, leg_reach
from creps_jax.robots.robot import GRAVITY, NaoRobot, Robot
from creps_jax.tools.export.c_code import network
from creps_jax.tools.export.c_header import floats, identifier, layer_tables, number, string_literal
from creps_jax.tools.export.formula import Formula, formula_of
from creps_jax.typing import ScalarLike
from creps_jax.walking import com_plan, controller, engine, footsteps, gaits, params, posture
from creps_jax.walking.controller import Walker
from creps_jax.walking.gaits import COMMAND_NAMES, command_range, is_steered, learned_walker


def save(path: Path, policy: Learned, *, robot: Robot | None = None, period: float = 0.02) -> None:
    """Write NAME.c and NAME.h, each atomically.

    Args:
        path: the .c file.
        policy: a walk, see `learned_walker`.
        robot: the robot of the policy; a policy of a `Humanoid` needs it. None is the NAO that it names.
        period: time between two set-points, s.

    Raises:
        UserError: if the policy is no walk or of another robot, or a file cannot be written.
    """
    header = path.with_suffix(".h")
    code, declarations = make_walk(policy, path.stem, robot=robot, period=period)
    save_text(header, declarations)
    save_text(path, code)


def make_walk(
    policy: Learned, name: str = "walk", *, robot: Robot | None = None, period: float = 0.02
) -> tuple[str, str]:
    """Return the C code and the header of a walk; all names begin with the name of the robot and `name`.

    Raises:
        UserError: as `save` does.
    """
    settings = {} if robot is None else {"robot": robot}
    try:
        walker = learned_walker(policy, period=period, **settings)
    except (TypeError, ValueError) as error:
        raise UserError(f"the policy cannot be written as a walk: {error}") from error
    robot, formula = walker.robot, formula_of(policy)
    layers = formula.layers
    ranges = zip(COMMAND_NAMES, *command_range(policy), strict=True)
    filled = {
        "VERSION": package_version(),
        # It stands in comments.
        "ROBOT": re.sub(r"[^\w .+-]", "_", robot.name),
        "HEADER": f"{name}.h",
        "PERIOD": number(np.float32(period)),
        "NUM_JOINTS": str(robot.num_joints),
        "NUM_NODES": str(com_plan.NUM_NODES),
        "RANGES": "\n".join(
            f"#define WALK_{axis.upper()}_{end} {number(value)}"
            for axis, low, high in ranges
            for end, value in (("LOW", low), ("HIGH", high))
        ),
        "JOINT_NAMES": ",\n".join(f"    {string_literal(joint)}" for joint in robot.own_names),
        "LAYERS": network(layers, "") if layers else "",
        "CONSTANTS": "\n".join(
            [
                *_engine_constants(walker),
                *_robot_constants(walker),
                *_leg_constants(robot),
                *_policy_constants(formula, policy),
            ]
        ),
    }
    prefix = prefix_of(robot, name)
    return tuple(_fill(file, filled, prefix) for file in ("walk_template.c", "walk_template.h"))  # type: ignore[return-value]


def prefix_of(robot: Robot, name: str) -> str:
    """Return what the names in the C code begin with: the robot and the name of the walk."""
    prefix = identifier(f"{robot.name}_{name}").lower()
    return f"robot_{prefix}" if prefix[:1].isdigit() else prefix or "walk"


def _fill(file: str, filled: dict[str, str], prefix: str) -> str:
    text = resources.files("creps_jax.tools.export").joinpath(file).read_text(encoding="utf-8")
    text = re.sub(r"\bwalk_(?=\w)", f"{prefix}_", text)
    text = re.sub(r"\bWALK_(?=\w)", f"{prefix.upper()}_", text)
    filled = filled | {"RANGES": filled["RANGES"].replace("WALK_", f"{prefix.upper()}_")}
    return re.sub(r"@(\w+)@", lambda found: filled[found[1]], text)


def _engine_constants(walker: Walker) -> list[str]:
    """Define the numbers of the engine, scaled to the robot, and the settings of the walker."""
    robot, size = walker.robot, walker.robot.size
    numbers = {
        "GRAVITY": GRAVITY,
        "HEADING_GAIN": walker.balance.heading_gain,
        "PLACEMENT_GAIN": walker.balance.placement_gain,
        "FORWARD_PLACEMENT_GAIN": walker.balance.forward_placement_gain,
        "FILTER_MEMORY": posture.filter_memory(walker.period, walker.balance.filter_time),
        "MAX_HEADING_ERROR": controller.MAX_HEADING_ERROR,
        "SIDE_BY_SIDE": controller.SIDE_BY_SIDE,
        "MAX_HEADING_STEP": engine.MAX_HEADING_STEP,
        "MAX_TILT": engine.MAX_TILT,
        "MAX_MEASURED": posture.MAX_MEASURED,
        "SWING_AHEAD": footsteps.SWING_AHEAD,
        "MAX_AMPLITUDE_SHARE": params.MAX_AMPLITUDE_SHARE,
        "MAX_AMPLITUDE": size * params.MAX_AMPLITUDE,
        "MAX_DOUBLE_SUPPORT_SHARE": params.MAX_DOUBLE_SUPPORT_SHARE,
        "LARGEST_SIDE": size * gaits.LARGEST_SIDE,
        "LARGEST_TURN": gaits.LARGEST_TURN,
    }
    safe_low, safe_high = params.scaled_bounds(robot, (params.SAFE_LOW, params.SAFE_HIGH))
    landing_low, landing_high = footsteps.landing_box(robot)
    vectors = {
        "ACCELERATION": walker.acceleration,
        "LANDING_LOW": landing_low,
        "LANDING_HIGH": landing_high,
        "SAFE_LOW": safe_low,
        "SAFE_HIGH": safe_high,
    }
    if walker.com == "continuous":
        vectors["LARGEST_SHIFT"] = tuple(size * shift for shift in com_plan.LARGEST_SHIFT)
    return [*_defined(numbers, {"IS_ONE_STEP": walker.com == "one_step"}), *_vectors(vectors)]


def _robot_constants(walker: Walker) -> list[str]:
    """Define the lengths and the joints of the robot."""
    robot = walker.robot
    numbers = {
        "ANKLE_HEIGHT": robot.ankle_height,
        "FOOT_SPACING": robot.foot_spacing,
        "COM_ABOVE_HIP": robot.com_above_hip,
        "COM_AHEAD_OF_HIP": robot.com_ahead_of_hip,
        "ZMP_AHEAD_OF_ANKLE": robot.zmp_ahead_of_ankle,
    }
    vectors = {
        "HIP_CENTRE": robot.hip_centre,
        "POSTURE": robot.posture,
        "ARM_SWING": robot.arm_swing,
        "JOINT_LOW": robot.joint_lower,
        "JOINT_HIGH": robot.joint_upper,
        "MAX_JOINT_SPEED": robot.max_joint_speed,
        "OUT_SIGN": robot.own_signs,
    }
    indices = [
        f"static const int {name}[{len(joints)}] = {{{', '.join(map(str, joints))}}};\n"
        for name, joints in (("LEFT_LEG", robot.left_leg), ("RIGHT_LEG", robot.right_leg))
    ]
    return [*_defined(numbers), *_vectors(vectors), *indices]


def _leg_constants(robot: Robot) -> list[str]:
    """Define the numbers of the inverse kinematics: lengths of a NAO, or the joint axes of a `Humanoid`.

    Raises:
        UserError: if the robot is neither.
    """
    if isinstance(robot, NaoRobot):
        return _nao_constants(robot)
    if isinstance(robot, Humanoid):
        return _chain_constants(robot)
    raise UserError(f"robot must be a NaoRobot or a Humanoid, whose kinematics are known, got {robot!r}")


def _nao_constants(robot: NaoRobot) -> list[str]:
    geometry, links, (least, largest) = robot.geometry, leg_links(robot), leg_reach(robot)
    yaws = robot.left_leg[0], robot.right_leg[0]
    numbers = {
        "HIP_Y": geometry.hip_y,
        "FOOT_DOWN": geometry.foot_down,
        "ANKLE_DROP": geometry.ankle_drop,
        "THIGH": links.thigh,
        "SHANK": links.shank,
        "BEND_AT_ZERO": links.bend_at_zero,
        "MIN_REACH": least,
        "MAX_REACH": largest,
        "SHARED_YAW_LOW": max(robot.joint_lower[index] for index in yaws),
        "SHARED_YAW_HIGH": min(robot.joint_upper[index] for index in yaws),
    }
    return _defined(numbers, {"IS_NAO": True, "ONE_YAW_MOTOR": robot.has_one_yaw_motor})


def _chain_constants(robot: Humanoid) -> list[str]:
    numbers = {
        "LARGEST_JOINT_STEP": screw_kinematics.LARGEST_STEP,
        "DAMPING": screw_kinematics.DAMPING,
        "LEAST_DAMPING": screw_kinematics.LEAST_DAMPING,
        "LARGEST_ERROR": screw_kinematics.LARGEST_ERROR,
    }
    counts = {
        "IS_NAO": False,
        "NUM_LEG_JOINTS": len(robot.left_leg),
        "FIRST_ITERATIONS": legs.FIRST_ITERATIONS,
        "ITERATIONS": legs.ITERATIONS,
    }
    lines = _defined(numbers, counts)
    for side, chain in (("LEFT", robot.left), ("RIGHT", robot.right)):
        for what, rows in (("AXES", chain.axes), ("POINTS", chain.points), ("SOLE", chain.sole[:3])):
            lines.append(floats(f"{side}_{what}[{len(rows)}][{rows.shape[1]}]", np.asarray(rows, np.float32)))
        ends = {"LOW": chain.lower, "HIGH": chain.upper, "WEIGHTS": chain.weights}
        lines += _vectors({f"{side}_{what}": values for what, values in ends.items()})
    return lines


def _policy_constants(formula: Formula, policy: Learned) -> list[str]:
    num_features, num_contexts = len(formula.coef), len(formula.context_low)
    lines = [
        f"#define IS_STEERED {int(is_steered(policy))}",
        f"#define IS_SQUASHED {int(policy.parameters.constraint == SIGMOID)}",
        f"#define NUM_CONTEXTS {num_contexts}",
        f"#define NUM_PARAMETERS {formula.coef.shape[1]}",
        f"#define NUM_FEATURES {num_features}",
        f"#define FEATURES_ARE_RBF {int(formula.kind == 'rbf')}",
        f"#define FEATURES_ARE_KERNEL {int(formula.kind == 'kernel')}",
        f"#define FEATURES_ARE_NETWORK {int(formula.kind == 'network')}",
        _vector("CONTEXT_LOW", formula.context_low),
        _vector("CONTEXT_HIGH", formula.context_high),
        _vector("PARAMETER_LOW", formula.param_low),
        _vector("PARAMETER_HIGH", formula.param_high),
        floats(f"COEF[{num_features}][{formula.coef.shape[1]}]", formula.coef),
    ]
    ends = [_vector("CONTEXT_MIDDLE", formula.middle), _vector("CONTEXT_HALF", formula.half)]
    if formula.kind in ("rbf", "kernel"):
        return [
            *lines,
            *(ends if formula.kind == "kernel" else []),
            floats(f"CENTERS[{len(formula.centers)}][{num_contexts}]", formula.centers),
            _vector("WIDTHS", formula.widths),
        ]
    rows = ", ".join(f"{{{', '.join(map(str, row))}}}" for row in formula.exponents)
    if formula.layers:
        return [*lines, *ends, *layer_tables(formula, "")]
    return [*lines, *ends, f"static const int EXPONENTS[{num_features}][{num_contexts}] = {{{rows}}};"]


def _defined(numbers: Mapping[str, ScalarLike], counts: Mapping[str, int] | None = None) -> list[str]:
    """Define numbers, and flags and other integers."""
    return [
        *(f"#define {name} {number(np.float32(float(value)))}" for name, value in numbers.items()),
        *(f"#define {name} {int(value)}" for name, value in (counts or {}).items()),
    ]


def _vectors(vectors: Mapping[str, Sequence[float] | np.ndarray]) -> list[str]:
    return [_vector(name, values) for name, values in vectors.items()]


def _vector(name: str, values: Sequence[float] | np.ndarray) -> str:
    return floats(f"{name}[{len(values)}]", np.asarray(values, np.float32))
