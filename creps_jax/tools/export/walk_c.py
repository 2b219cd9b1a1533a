"""Write a whole walk as C: policy, planner, kinematics and feedback, for robots without Python."""

import itertools
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from creps_jax.errors import UserError
from creps_jax.files import package_version, save_text
from creps_jax.policies.bounds import SIGMOID
from creps_jax.policies.features import describe
from creps_jax.policies.learned import Learned
from creps_jax.robots.nao_geometry import LEFT, RIGHT, leg_indices
from creps_jax.robots.nao_kinematics import leg_links, leg_reach
from creps_jax.tools.export.c_header import floats, identifier, number
from creps_jax.tools.export.formula import formula_of
from creps_jax.walking import com_plan, controller, engine, footsteps, gaits, params, posture
from creps_jax.walking.controller import Walker
from creps_jax.walking.gaits import COMMAND_NAMES, command_range, is_steered, learned_walker

_KINDS = ("linear", "polynomial", "rbf")


def save(path: Path, policy: Learned, *, period: float = 0.02) -> None:
    """Write NAME.c and NAME.h, each atomically.

    Args:
        path: the .c file.
        policy: a walk, see `learned_walker`.
        period: time between two set-points, s.

    Raises:
        UserError: if the policy is no walk, or a file cannot be written.
    """
    header = path.with_suffix(".h")
    code, declarations = make_walk(policy, path.stem, period=period)
    save_text(header, declarations)
    save_text(path, code)


def make_walk(policy: Learned, name: str = "walk", *, period: float = 0.02) -> tuple[str, str]:
    """Return the C code and the header of a walk; all names begin with the name of the robot and `name`.

    Raises:
        UserError: as `save` does.
    """
    try:
        walker = learned_walker(policy, period=period)
    except (TypeError, ValueError) as error:
        raise UserError(f"the policy cannot be written as a walk: {error}") from error
    robot = walker.robot
    ranges = zip(COMMAND_NAMES, *command_range(policy), strict=True)
    filled = {
        "VERSION": package_version(),
        "ROBOT": robot.name,
        "HEADER": f"{name}.h",
        "PERIOD": number(np.float32(period)),
        "NUM_JOINTS": str(len(robot.joint_lower)),
        "NUM_NODES": str(com_plan.NUM_NODES),
        "RANGES": "\n".join(
            f"#define WALK_{axis.upper()}_{end} {number(value)}"
            for axis, low, high in ranges
            for end, value in (("LOW", low), ("HIGH", high))
        ),
        "JOINT_NAMES": ",\n".join(f'    "{joint}"' for joint in robot.own_names),
        "CONSTANTS": "\n".join(_constants(policy, walker)),
    }
    prefix = identifier(f"{robot.name}_{name}").lower()
    return tuple(_fill(file, filled, prefix) for file in ("walk_template.c", "walk_template.h"))  # type: ignore[return-value]


def _fill(file: str, filled: dict[str, str], prefix: str) -> str:
    text = resources.files("creps_jax.tools.export").joinpath(file).read_text(encoding="utf-8")
    text = re.sub(r"\bwalk_(?=\w)", f"{prefix}_", text)
    text = re.sub(r"\bWALK_(?=\w)", f"{prefix.upper()}_", text)
    filled = filled | {"RANGES": filled["RANGES"].replace("WALK_", f"{prefix.upper()}_")}
    return re.sub(r"@(\w+)@", lambda found: filled[found[1]], text)


def _constants(policy: Learned, walker: Walker) -> list[str]:
    """Define all numbers of the robot, the engine and the policy."""
    robot, geometry = walker.robot, walker.robot.geometry
    links, (least, largest) = leg_links(robot), leg_reach(robot)
    yaws = [leg_indices(side).start for side in (LEFT, RIGHT)]
    numbers = {
        "GRAVITY": params.GRAVITY,
        "HIP_X": geometry.hip_x,
        "HIP_Y": geometry.hip_y,
        "HIP_Z": geometry.hip_z,
        "FOOT_DOWN": geometry.foot_down,
        "ANKLE_DROP": geometry.ankle_drop,
        "ANKLE_HEIGHT": geometry.ankle_height,
        "THIGH": links.thigh,
        "SHANK": links.shank,
        "BEND_AT_ZERO": links.bend_at_zero,
        "MIN_REACH": least,
        "MAX_REACH": largest,
        "FOOT_SPACING": robot.foot_spacing,
        "COM_ABOVE_HIP": robot.com_above_hip,
        "COM_AHEAD_OF_HIP": robot.com_ahead_of_hip,
        "ZMP_AHEAD_OF_ANKLE": robot.zmp_ahead_of_ankle,
        "SHARED_YAW_LOW": max(robot.joint_lower[index] for index in yaws),
        "SHARED_YAW_HIGH": min(robot.joint_upper[index] for index in yaws),
        "HEADING_GAIN": walker.balance.heading_gain,
        "PLACEMENT_GAIN": walker.balance.placement_gain,
        "FILTER_MEMORY": posture.filter_memory(walker.period, walker.balance.filter_time),
        "MAX_HEADING_ERROR": controller.MAX_HEADING_ERROR,
        "SIDE_BY_SIDE": controller.SIDE_BY_SIDE,
        "MAX_HEADING_STEP": engine.MAX_HEADING_STEP,
        "MAX_TILT": engine.MAX_TILT,
        "ARM_SWING": engine.ARM_SWING,
        "SHOULDER_PITCH": engine.SHOULDER_PITCH,
        "SHOULDER_YAW": engine.SHOULDER_YAW,
        "ARM_ROLL": engine.ARM_ROLL,
        "ELBOW": engine.ELBOW,
        "MAX_MEASURED": posture.MAX_MEASURED,
        "SWING_AHEAD": footsteps.SWING_AHEAD,
        "MAX_AMPLITUDE_SHARE": params.MAX_AMPLITUDE_SHARE,
        "MAX_AMPLITUDE": params.MAX_AMPLITUDE,
        "MAX_DOUBLE_SUPPORT_SHARE": params.MAX_DOUBLE_SUPPORT_SHARE,
        "LARGEST_SIDE": gaits.LARGEST_SIDE,
        "LARGEST_TURN": gaits.LARGEST_TURN,
    }
    vectors = {
        "ACCELERATION": walker.acceleration,
        "LANDING_LOW": footsteps.LANDING_LOW,
        "LANDING_HIGH": footsteps.LANDING_HIGH,
        "SAFE_LOW": params.SAFE_LOW,
        "SAFE_HIGH": params.SAFE_HIGH,
        "JOINT_LOW": robot.joint_lower,
        "JOINT_HIGH": robot.joint_upper,
        "MAX_JOINT_SPEED": robot.max_joint_speed,
        "OUT_SIGN": robot.own_signs,
    }
    if walker.com == "continuous":
        vectors["LARGEST_SHIFT"] = com_plan.LARGEST_SHIFT
    flags = {
        "ONE_YAW_MOTOR": robot.has_one_yaw_motor,
        "IS_ONE_STEP": walker.com == "one_step",
        "IS_STEERED": is_steered(policy),
        "IS_SQUASHED": policy.parameters.constraint == SIGMOID,
    }
    return [
        *(f"#define {name} {number(np.float32(float(value)))}" for name, value in numbers.items()),
        *(f"#define {name} {int(value)}" for name, value in flags.items()),
        *_policy_constants(policy),
        *(_vector(name, values) for name, values in vectors.items()),
    ]


def _policy_constants(policy: Learned) -> list[str]:
    formula = formula_of(policy, _KINDS)
    num_features, num_contexts = len(formula.coef), len(formula.context_low)
    is_rbf = len(formula.centers) > 0
    lines = [
        f"#define NUM_CONTEXTS {num_contexts}",
        f"#define NUM_PARAMETERS {formula.coef.shape[1]}",
        f"#define NUM_FEATURES {num_features}",
        f"#define FEATURES_ARE_RBF {int(is_rbf)}",
        _vector("CONTEXT_LOW", formula.context_low),
        _vector("CONTEXT_HIGH", formula.context_high),
        _vector("PARAMETER_LOW", formula.param_low),
        _vector("PARAMETER_HIGH", formula.param_high),
        floats(f"COEF[{num_features}][{formula.coef.shape[1]}]", formula.coef),
    ]
    if is_rbf:
        return [
            *lines,
            floats(f"CENTERS[{num_features}][{num_contexts}]", formula.centers),
            _vector("WIDTHS", formula.widths),
        ]
    rows = ", ".join(f"{{{', '.join(map(str, row))}}}" for row in exponents(policy))
    return [*lines, f"static const int EXPONENTS[{num_features}][{num_contexts}] = {{{rows}}};"]


def exponents(policy: Learned) -> list[tuple[int, ...]]:
    """Return the exponent of each context variable in each of the linear or polynomial features."""
    features = describe(policy.features)
    dim, degree = features["dim"], features.get("degree", 1)
    rows = []
    for each in range(degree + 1):
        for variables in itertools.combinations_with_replacement(range(dim), each):
            rows.append(tuple(variables.count(variable) for variable in range(dim)))
    return rows


def _vector(name: str, values: Sequence[float] | np.ndarray) -> str:
    return floats(f"{name}[{len(values)}]", np.asarray(values, np.float32))
