/* A learned walk: from commanded speeds and the measured orientation of the trunk to joint set-points.
 *
 * Made by creps_jax @VERSION@ for the robot @ROBOT@. C99; needs only libm, allocates nothing. See the header.
 */
#include "@HEADER@"

#include <math.h>
#include <stddef.h>

#define PI 3.14159265358979f
#define NODES WALK_NUM_NODES
#define INTERVALS ((float)(NODES - 1))

enum { AMPLITUDE, HIP_HEIGHT, SWING_HEIGHT, STEP_DURATION, LEAN, TILT_GAIN, ROLL_GAIN, STEP_LENGTH, DOUBLE_SUPPORT, STEP_GROWTH };

@CONSTANTS@

const char *const walk_joint_names[WALK_NUM_JOINTS] = {
@JOINT_NAMES@
};

static float clip(float value, float low, float high)
{
    return value < low ? low : value > high ? high : value;
}

/* Return the equal angle from -pi to pi. */
static float wrapped(float angle)
{
    return angle - 2.0f * PI * rintf(angle / (2.0f * PI));
}

static float smooth_step(float phase)
{
    phase = clip(phase, 0.0f, 1.0f);
    return phase * phase * (3.0f - 2.0f * phase);
}

static void copy3(float to[3], const float from[3])
{
    int i;
    for (i = 0; i < 3; ++i) {
        to[i] = from[i];
    }
}

/* ---- planar poses (x, y, yaw) ---- */

static void compose(const float pose[3], const float offset[3], float result[3])
{
    const float c = cosf(pose[2]), s = sinf(pose[2]);
    const float x = pose[0] + c * offset[0] - s * offset[1];
    const float y = pose[1] + s * offset[0] + c * offset[1];
    result[2] = pose[2] + offset[2];
    result[0] = x;
    result[1] = y;
}

static void relative_pose(const float pose[3], const float other[3], float result[3])
{
    const float c = cosf(pose[2]), s = sinf(pose[2]);
    const float x = other[0] - pose[0], y = other[1] - pose[1];
    result[2] = other[2] - pose[2];
    result[0] = c * x + s * y;
    result[1] = c * y - s * x;
}

/* ---- rotations ---- */

typedef struct {
    float m[3][3];
} matrix;

/* A sole in the frame of the trunk. */
typedef struct {
    matrix rotation;
    float position[3];
} sole_pose;

static matrix product(const matrix *a, const matrix *b)
{
    matrix r;
    int i, j, k;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            r.m[i][j] = 0.0f;
            for (k = 0; k < 3; ++k) {
                r.m[i][j] += a->m[i][k] * b->m[k][j];
            }
        }
    }
    return r;
}

static matrix transposed(const matrix *a)
{
    matrix r;
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            r.m[i][j] = a->m[j][i];
        }
    }
    return r;
}

static void rotated(const matrix *a, const float v[3], float result[3])
{
    int i;
    for (i = 0; i < 3; ++i) {
        result[i] = a->m[i][0] * v[0] + a->m[i][1] * v[1] + a->m[i][2] * v[2];
    }
}

static matrix rotation_x(float angle)
{
    const float c = cosf(angle), s = sinf(angle);
    const matrix r = {{{1.0f, 0.0f, 0.0f}, {0.0f, c, -s}, {0.0f, s, c}}};
    return r;
}

static matrix rotation_y(float angle)
{
    const float c = cosf(angle), s = sinf(angle);
    const matrix r = {{{c, 0.0f, s}, {0.0f, 1.0f, 0.0f}, {-s, 0.0f, c}}};
    return r;
}

static matrix rotation_z(float angle)
{
    const float c = cosf(angle), s = sinf(angle);
    const matrix r = {{{c, -s, 0.0f}, {s, c, 0.0f}, {0.0f, 0.0f, 1.0f}}};
    return r;
}

/* ---- the legs ---- */

#if IS_NAO
/* Knee and ankle pitch for a position of the hip ahead of and above the ankle pitch axis. */
static void solve_plane(float hip_x, float hip_z, float *knee, float *ankle_pitch)
{
    const float square = hip_x * hip_x + hip_z * hip_z;
    const float distance = clip(sqrtf(square > 1e-8f ? square : 1e-8f), MIN_REACH, MAX_REACH);
    const float cosine =
        (distance * distance - THIGH * THIGH - SHANK * SHANK) / (2.0f * THIGH * SHANK);
    const float bend = acosf(clip(cosine, -1.0f, 1.0f));
    const float shank_to_hip = atan2f(THIGH * sinf(bend), SHANK + THIGH * cosf(bend));
    *knee = BEND_AT_ZERO - bend;
    *ankle_pitch = atan2f(hip_x, hip_z) + shank_to_hip;
}

static void hip_position(float side, float result[3])
{
    result[0] = HIP_CENTRE[0];
    result[1] = side * HIP_Y;
    result[2] = HIP_CENTRE[1];
}

/* Joint angles of a leg for a pose of its sole, in closed form. */
static void leg_ik(const sole_pose *sole, float side, float joints[6])
{
    const float fold = 0.003f, tilt = side * PI / 4.0f;
    const matrix inverse = transposed(&sole->rotation);
    float hip[3], x[3], height, in_plane, knee, ankle_pitch, ankle_roll, first, second, third, c, s;
    matrix a, b, r;
    int i;

    hip_position(side, hip);
    for (i = 0; i < 3; ++i) {
        hip[i] -= sole->position[i];
    }
    rotated(&inverse, hip, x);
    x[2] -= FOOT_DOWN;
    height = fabsf(x[2]) > fold ? fabsf(x[2]) : fold;
    ankle_roll = atan2f(x[1] * clip(x[2] / fold, -1.0f, 1.0f), height);
    in_plane = cosf(ankle_roll) * x[2] + sinf(ankle_roll) * x[1];
    solve_plane(x[0], in_plane - ANKLE_DROP, &knee, &ankle_pitch);

    a = rotation_x(-ankle_roll);
    r = product(&sole->rotation, &a);
    a = rotation_y(knee + ankle_pitch);
    r = product(&r, &a);
    b = rotation_x(-tilt);
    r = product(&b, &r);
    first = atan2f(-r.m[0][1], r.m[1][1]);
    c = cosf(first);
    s = sinf(first);
    second = atan2f(r.m[2][1], c * r.m[1][1] - s * r.m[0][1]);
    third = atan2f(c * r.m[0][2] + s * r.m[1][2], c * r.m[0][0] + s * r.m[1][0]);
    joints[0] = -side * first;
    joints[1] = second + tilt;
    joints[2] = -third;
    joints[3] = knee;
    joints[4] = ankle_pitch;
    joints[5] = ankle_roll;
}

#if ONE_YAW_MOTOR
/* The same for a given hip yaw-pitch, which turns the sole in its plane. */
static void leg_ik_with_yaw(const sole_pose *sole, float side, float yaw_pitch, float joints[6])
{
    const float tilt = side * PI / 4.0f;
    const float up[3] = {sole->rotation.m[0][2], sole->rotation.m[1][2], sole->rotation.m[2][2]};
    float hip[3], ankle[3], p[3], hip_roll, knee, square, ankle_pitch;
    matrix a, pelvis, shank, inverse;
    int i;

    a = rotation_x(tilt);
    pelvis = rotation_z(-side * yaw_pitch);
    pelvis = product(&a, &pelvis);
    a = rotation_x(-tilt);
    pelvis = product(&pelvis, &a);
    hip_position(side, hip);
    for (i = 0; i < 3; ++i) {
        ankle[i] = sole->position[i] + FOOT_DOWN * up[i] - hip[i];
    }
    inverse = transposed(&pelvis);
    rotated(&inverse, ankle, p);
    hip_roll = atan2f(p[1], -p[2]);
    solve_plane(-p[0], sinf(hip_roll) * p[1] - cosf(hip_roll) * p[2], &knee, &square);
    a = rotation_x(hip_roll);
    shank = product(&pelvis, &a);
    a = rotation_y(square);
    shank = product(&shank, &a);
    inverse = transposed(&shank);
    rotated(&inverse, up, p);
    ankle_pitch = atan2f(-p[0], p[2]);
    joints[0] = yaw_pitch;
    joints[1] = hip_roll;
    joints[2] = -knee - square;
    joints[3] = knee;
    joints[4] = ankle_pitch;
    joints[5] = atan2f(-p[1], cosf(ankle_pitch) * p[2] - sinf(ankle_pitch) * p[0]);
}
#endif

/* Write the joint angles of both legs, left and right, for the poses of their soles. */
static void solve_legs(const sole_pose soles[2], const float last[], float joints[])
{
    float left[6], right[6];
    int i;
    (void)last;
    leg_ik(&soles[0], 1.0f, left);
    leg_ik(&soles[1], -1.0f, right);
#if ONE_YAW_MOTOR
    {
        const float shared = clip(0.5f * (left[0] + right[0]), SHARED_YAW_LOW, SHARED_YAW_HIGH);
        leg_ik_with_yaw(&soles[0], 1.0f, shared, left);
        leg_ik_with_yaw(&soles[1], -1.0f, shared, right);
    }
#endif
    for (i = 0; i < 6; ++i) {
        joints[LEFT_LEG[i]] = left[i];
        joints[RIGHT_LEG[i]] = right[i];
    }
}
#else
/* A leg by its joint axes from hip to ankle, with all its angles zero, in the frame of the trunk. */
typedef struct {
    const int *joints;                                  /* index of each in a joint vector */
    const float (*axes)[3], (*points)[3], (*sole)[4];
    const float *low, *high;                            /* limits of the angles, rad */
    const float *weights;                               /* of errors along and about x, y, z of the sole */
} leg_chain;

static const leg_chain LEGS[2] = {
    {LEFT_LEG, LEFT_AXES, LEFT_POINTS, LEFT_SOLE, LEFT_LOW, LEFT_HIGH, LEFT_WEIGHTS},
    {RIGHT_LEG, RIGHT_AXES, RIGHT_POINTS, RIGHT_SOLE, RIGHT_LOW, RIGHT_HIGH, RIGHT_WEIGHTS},
};

/* Return the rotation about a unit axis. */
static matrix rotation_about(const float axis[3], float angle)
{
    const matrix cross = {{{0.0f, -axis[2], axis[1]}, {axis[2], 0.0f, -axis[0]}, {-axis[1], axis[0], 0.0f}}};
    const float s = sinf(angle), versine = 1.0f - cosf(angle);
    matrix r = product(&cross, &cross);
    int i, j;
    for (i = 0; i < 3; ++i) {
        for (j = 0; j < 3; ++j) {
            r.m[i][j] = (i == j ? 1.0f : 0.0f) + s * cross.m[i][j] + versine * r.m[i][j];
        }
    }
    return r;
}

/* Compute the pose of the sole at the angles of a leg, and there each joint's axis and a point on it. */
static void leg_fk(
    const leg_chain *leg, const float angles[NUM_LEG_JOINTS], sole_pose *sole, float axes[NUM_LEG_JOINTS][3],
    float points[NUM_LEG_JOINTS][3])
{
    matrix rotation = {{{1.0f, 0.0f, 0.0f}, {0.0f, 1.0f, 0.0f}, {0.0f, 0.0f, 1.0f}}}, turned;
    float shift[3] = {0.0f, 0.0f, 0.0f}, place[3];
    int joint, i, j;
    for (joint = 0; joint < NUM_LEG_JOINTS; ++joint) {
        rotated(&rotation, leg->axes[joint], axes[joint]);
        rotated(&rotation, leg->points[joint], points[joint]);
        turned = rotation_about(leg->axes[joint], angles[joint]);
        rotation = product(&rotation, &turned);
        rotated(&rotation, leg->points[joint], place);
        for (i = 0; i < 3; ++i) {
            points[joint][i] += shift[i];
            shift[i] = points[joint][i] - place[i];
        }
    }
    for (i = 0; i < 3; ++i) {
        place[i] = leg->sole[i][3];
        for (j = 0; j < 3; ++j) {
            turned.m[i][j] = leg->sole[i][j];
        }
    }
    sole->rotation = product(&rotation, &turned);
    rotated(&rotation, place, sole->position);
    for (i = 0; i < 3; ++i) {
        sole->position[i] += shift[i];
    }
}

/* Weight a displacement and a rotation along and about the axes of the sole. */
static void weigh(
    const leg_chain *leg, const matrix *to_sole, const float along[3], const float about[3], float result[6])
{
    int i;
    rotated(to_sole, along, result);
    rotated(to_sole, about, result + 3);
    for (i = 0; i < 6; ++i) {
        result[i] *= leg->weights[i];
    }
}

static float dot6(const float a[6], const float b[6])
{
    float sum = 0.0f;
    int i;
    for (i = 0; i < 6; ++i) {
        sum += a[i] * b[i];
    }
    return sum;
}

/* Solve a positive definite system by Cholesky's method, in place. */
static void solve_positive(float a[NUM_LEG_JOINTS][NUM_LEG_JOINTS], float x[NUM_LEG_JOINTS])
{
    int i, j, k;
    for (i = 0; i < NUM_LEG_JOINTS; ++i) {
        for (j = 0; j <= i; ++j) {
            for (k = 0; k < j; ++k) {
                a[i][j] -= a[i][k] * a[j][k];
            }
            a[i][j] = i == j ? sqrtf(a[i][i]) : a[i][j] / a[j][j];
        }
        for (k = 0; k < i; ++k) {
            x[i] -= a[i][k] * x[k];
        }
        x[i] /= a[i][i];
    }
    for (i = NUM_LEG_JOINTS - 1; i >= 0; --i) {
        for (k = i + 1; k < NUM_LEG_JOINTS; ++k) {
            x[i] -= a[k][i] * x[k];
        }
        x[i] /= a[i][i];
    }
}

/* Solve for a step in place; entries beyond their limits are set to them, and the others solved again. */
static void solve_within(
    float a[NUM_LEG_JOINTS][NUM_LEG_JOINTS],
    const float lowest[NUM_LEG_JOINTS],
    const float highest[NUM_LEG_JOINTS],
    float x[NUM_LEG_JOINTS])
{
    float factor[NUM_LEG_JOINTS][NUM_LEG_JOINTS], rest[NUM_LEG_JOINTS], at_limit[NUM_LEG_JOINTS];
    int is_free[NUM_LEG_JOINTS], i, j;
    for (i = 0; i < NUM_LEG_JOINTS; ++i) {
        rest[i] = x[i];
        for (j = 0; j < NUM_LEG_JOINTS; ++j) {
            factor[i][j] = a[i][j];
        }
    }
    solve_positive(factor, x);
    for (i = 0; i < NUM_LEG_JOINTS; ++i) {
        is_free[i] = x[i] >= lowest[i] && x[i] <= highest[i];
        at_limit[i] = is_free[i] ? 0.0f : clip(x[i], lowest[i], highest[i]);
    }
    for (i = 0; i < NUM_LEG_JOINTS; ++i) {
        for (j = 0; j < NUM_LEG_JOINTS; ++j) {
            rest[i] -= a[i][j] * at_limit[j];
            factor[i][j] = is_free[i] && is_free[j] ? a[i][j] : (i == j ? 1.0f : 0.0f);
        }
        x[i] = is_free[i] ? rest[i] : at_limit[i];
    }
    solve_positive(factor, x);
}

/* Compute the damped Newton step for the error of the pose, lengths relative to that of the leg. */
static void newton_step(
    const leg_chain *leg, const sole_pose *wanted, const float angles[NUM_LEG_JOINTS], float step[NUM_LEG_JOINTS])
{
    const float length = fabsf(leg->sole[2][3] - leg->points[0][2]);
    float axes[NUM_LEG_JOINTS][3], points[NUM_LEG_JOINTS][3], columns[NUM_LEG_JOINTS][6];
    float normal[NUM_LEG_JOINTS][NUM_LEG_JOINTS], lowest[NUM_LEG_JOINTS], highest[NUM_LEG_JOINTS];
    float along[3], about[3], error[6], damping;
    sole_pose sole;
    matrix to_sole, turn;
    int i, j;

    leg_fk(leg, angles, &sole, axes, points);
    to_sole = transposed(&sole.rotation);
    turn = product(&wanted->rotation, &to_sole);
    for (i = 0; i < 3; ++i) {
        along[i] = (wanted->position[i] - sole.position[i]) / length;
    }
    about[0] = 0.5f * (turn.m[2][1] - turn.m[1][2]);
    about[1] = 0.5f * (turn.m[0][2] - turn.m[2][0]);
    about[2] = 0.5f * (turn.m[1][0] - turn.m[0][1]);
    weigh(leg, &to_sole, along, about, error);
    for (j = 0; j < NUM_LEG_JOINTS; ++j) {
        const float *axis = axes[j];
        for (i = 0; i < 3; ++i) {
            about[i] = (sole.position[i] - points[j][i]) / length;
        }
        along[0] = axis[1] * about[2] - axis[2] * about[1];
        along[1] = axis[2] * about[0] - axis[0] * about[2];
        along[2] = axis[0] * about[1] - axis[1] * about[0];
        weigh(leg, &to_sole, along, axis, columns[j]);
    }
    damping = DAMPING * fminf(dot6(error, error), LARGEST_ERROR) + LEAST_DAMPING;
    for (i = 0; i < NUM_LEG_JOINTS; ++i) {
        for (j = 0; j < NUM_LEG_JOINTS; ++j) {
            normal[i][j] = dot6(columns[i], columns[j]) + (i == j ? damping : 0.0f);
        }
        step[i] = dot6(columns[i], error);
        lowest[i] = leg->low[i] - angles[i];
        highest[i] = leg->high[i] - angles[i];
    }
    solve_within(normal, lowest, highest, step);
}

/* Write the joint angles of both legs, left and right, for the poses of their soles: Newton steps from the
 * joint angles one period before, or from the posture of standing if there are none. */
static void solve_legs(const sole_pose soles[2], const float last[], float joints[])
{
    const float *start = last ? last : POSTURE;
    const int iterations = last ? ITERATIONS : FIRST_ITERATIONS;
    int side, iteration, i;
    for (side = 0; side < 2; ++side) {
        const leg_chain *leg = &LEGS[side];
        float angles[NUM_LEG_JOINTS], step[NUM_LEG_JOINTS];
        for (i = 0; i < NUM_LEG_JOINTS; ++i) {
            angles[i] = clip(start[leg->joints[i]], leg->low[i], leg->high[i]);
        }
        for (iteration = 0; iteration < iterations; ++iteration) {
            newton_step(leg, &soles[side], angles, step);
            for (i = 0; i < NUM_LEG_JOINTS; ++i) {
                angles[i] = clip(
                    angles[i] + clip(step[i], -LARGEST_JOINT_STEP, LARGEST_JOINT_STEP), leg->low[i], leg->high[i]);
            }
        }
        for (i = 0; i < NUM_LEG_JOINTS; ++i) {
            joints[leg->joints[i]] = angles[i];
        }
    }
}
#endif

/* ---- the policy: from a command to a gait ---- */

static void compute_features(const float context[NUM_CONTEXTS], float features[NUM_FEATURES])
{
    int i, j;
#if FEATURES_ARE_RBF
    float largest = 0.0f, sum = 0.0f;
    for (i = 0; i < NUM_FEATURES; ++i) {
        features[i] = 0.0f;
        for (j = 0; j < NUM_CONTEXTS; ++j) {
            const float distance = (context[j] - CENTERS[i][j]) / WIDTHS[j];
            features[i] -= 0.5f * distance * distance;
        }
        if (i == 0 || features[i] > largest) {
            largest = features[i];
        }
    }
    for (i = 0; i < NUM_FEATURES; ++i) {
        features[i] = expf(features[i] - largest);
        sum += features[i];
    }
    for (i = 0; i < NUM_FEATURES; ++i) {
        features[i] /= sum;
    }
#else
    float scaled[NUM_CONTEXTS];
    for (j = 0; j < NUM_CONTEXTS; ++j) {
        scaled[j] = (context[j] - CONTEXT_MIDDLE[j]) / CONTEXT_HALF[j];
    }
#if FEATURES_ARE_KERNEL
    features[0] = 1.0f;
    for (i = 1; i < NUM_FEATURES; ++i) {
        float square = 0.0f;
        for (j = 0; j < NUM_CONTEXTS; ++j) {
            const float distance = (scaled[j] - CENTERS[i - 1][j]) / WIDTHS[j];
            square += distance * distance;
        }
        features[i] = expf(-0.5f * square);
    }
#elif FEATURES_ARE_NETWORK
@LAYERS@#else
    for (i = 0; i < NUM_FEATURES; ++i) {
        features[i] = 1.0f;
        for (j = 0; j < NUM_CONTEXTS; ++j) {
            int k;
            for (k = 0; k < EXPONENTS[i][j]; ++k) {
                features[i] *= scaled[j];
            }
        }
    }
#endif
#endif
}

static void compute_theta(const float context[NUM_CONTEXTS], float theta[NUM_PARAMETERS])
{
    float features[NUM_FEATURES];
    int i, j;
    compute_features(context, features);
    for (j = 0; j < NUM_PARAMETERS; ++j) {
        theta[j] = 0.0f;
        for (i = 0; i < NUM_FEATURES; ++i) {
            theta[j] += features[i] * COEF[i][j];
        }
#if IS_SQUASHED
        theta[j] = PARAMETER_LOW[j] + (PARAMETER_HIGH[j] - PARAMETER_LOW[j]) / (1.0f + expf(-theta[j]));
#endif
        theta[j] = clip(theta[j], PARAMETER_LOW[j], PARAMETER_HIGH[j]);
    }
}

/* Read the gait for a command: ten walking parameters in SI units, and a step (x, y, yaw). */
static void read_gait(const float command[3], float params[10], float step[3])
{
    float context[NUM_CONTEXTS], theta[NUM_PARAMETERS], highest;
    int i;
#if IS_STEERED
    float length = 0.0f;
#endif
    /* Conditions are as near to zero as their range allows. */
    for (i = 0; i < NUM_CONTEXTS; ++i) {
        context[i] = clip(0.0f, CONTEXT_LOW[i], CONTEXT_HIGH[i]);
    }
#if IS_STEERED
    for (i = 0; i < 3; ++i) {
        const float middle = 0.5f * (CONTEXT_LOW[i] + CONTEXT_HIGH[i]);
        const float half = 0.5f * (CONTEXT_HIGH[i] - CONTEXT_LOW[i]);
        context[i] = (command[i] - middle) / half;
        length += context[i] * context[i];
    }
    length = sqrtf(length > 1.0f ? length : 1.0f);
    for (i = 0; i < 3; ++i) {
        const float middle = 0.5f * (CONTEXT_LOW[i] + CONTEXT_HIGH[i]);
        const float half = 0.5f * (CONTEXT_HIGH[i] - CONTEXT_LOW[i]);
        context[i] = middle + half * context[i] / length;
    }
#else
    context[0] = clip(fabsf(command[0]), CONTEXT_LOW[0], CONTEXT_HIGH[0]);
#endif
    compute_theta(context, theta);
    for (i = 0; i < 10; ++i) {
        params[i] = clip(theta[i], SAFE_LOW[i], SAFE_HIGH[i]);
    }
    highest = MAX_AMPLITUDE_SHARE * GRAVITY * params[STEP_DURATION] * params[STEP_DURATION] / (4.0f * PI * PI);
    highest = highest < MAX_AMPLITUDE ? highest : MAX_AMPLITUDE;
    params[AMPLITUDE] = clip(params[AMPLITUDE], 0.0f, highest);
    params[LEAN] *= PI / 180.0f;
    params[DOUBLE_SUPPORT] =
        clip(params[DOUBLE_SUPPORT], 0.0f, MAX_DOUBLE_SUPPORT_SHARE * params[STEP_DURATION]);
#if IS_STEERED
    step[0] = params[STEP_LENGTH];
    step[1] = clip(theta[10], -LARGEST_SIDE, LARGEST_SIDE);
    step[2] = clip(theta[11], -LARGEST_TURN, LARGEST_TURN);
#else
    step[0] = params[STEP_LENGTH] * clip(command[0] / context[0], -1.0f, 1.0f);
    step[1] = params[STEP_DURATION] * command[1];
    step[2] = params[STEP_DURATION] * command[2];
#endif
}

/* ---- the step planner ---- */

/* Limit a pose, seen from the support foot, to a share of the box in which the swing foot may land. */
static void limit_landing(float seen[3], float swing_side, float share)
{
    int i;
    for (i = 0; i < 3; ++i) {
        const float mirror = i == 1 ? swing_side : 1.0f;
        seen[i] = mirror * clip(mirror * seen[i], share * LANDING_LOW[i], share * LANDING_HIGH[i]);
    }
}

static void next_footstep(
    const float params[10], const walk_stance *stance, const float wanted[3], walk_footstep *footstep,
    walk_stance *after)
{
    const float swing_side = stance->supports_left ? -1.0f : 1.0f;
    const float growth = params[STEP_GROWTH] * params[STEP_DURATION];
    float step[3], ahead[3], sideways[3] = {0.0f, 0.0f, 0.0f}, pose[3];
    int i;
    for (i = 0; i < 3; ++i) {
        const float limit = i == 2 ? growth / FOOT_SPACING : growth;
        const float nearest = wanted[i] < 0.0f ? wanted[i] : 0.0f, farthest = wanted[i] > 0.0f ? wanted[i] : 0.0f;
        const float shrunk = clip(stance->step[i], nearest, farthest);
        step[i] = shrunk + clip(wanted[i] - shrunk, -limit, limit);
        ahead[i] = SWING_AHEAD * step[i];
    }
    sideways[1] = 0.5f * FOOT_SPACING * swing_side;
    footstep->supports_left = stance->supports_left;
    copy3(footstep->support, stance->supports_left ? stance->left : stance->right);
    copy3(footstep->swing_start, stance->supports_left ? stance->right : stance->left);
    compose(stance->body, ahead, pose);
    compose(pose, sideways, pose);
    relative_pose(footstep->support, pose, pose);
    limit_landing(pose, swing_side, 1.0f);
    compose(footstep->support, pose, footstep->swing_end);
    compose(stance->body, step, pose);
    relative_pose(footstep->support, pose, pose);
    limit_landing(pose, swing_side, 0.5f);
    compose(footstep->support, pose, after->body);
    copy3(after->left, stance->supports_left ? stance->left : footstep->swing_end);
    copy3(after->right, stance->supports_left ? footstep->swing_end : stance->right);
    after->supports_left = !stance->supports_left;
    copy3(after->step, step);
}

static int is_side_by_side(const walk_stance *stance)
{
    float apart[3];
    relative_pose(stance->left, stance->right, apart);
    apart[1] += FOOT_SPACING;
    return fabsf(apart[0]) < SIDE_BY_SIDE && fabsf(apart[1]) < SIDE_BY_SIDE && fabsf(apart[2]) < SIDE_BY_SIDE;
}

/* ---- the centre of mass: a spring-mass pendulum, a tridiagonal system ---- */

typedef struct {
    float height[NODES], acceleration[NODES];
    float duration, period;
} pendulum;

static void make_pendulum(const float params[10], pendulum *p)
{
    const float omega = 2.0f * PI / params[STEP_DURATION];
    int i;
    p->duration = params[STEP_DURATION];
    p->period = p->duration / INTERVALS;
    for (i = 0; i < NODES; ++i) {
        const float oscillation = params[AMPLITUDE] * cosf(2.0f * PI * ((float)i / INTERVALS));
        p->height[i] = params[HIP_HEIGHT] + oscillation + ANKLE_HEIGHT + COM_ABOVE_HIP;
        p->acceleration[i] = -omega * omega * oscillation;
    }
}

static float pendulum_rate(const pendulum *p, int node)
{
    return (GRAVITY + p->acceleration[node]) / p->height[node];
}

#if !IS_ONE_STEP
static float first_velocity(const pendulum *p, const float com[NODES], const float zmp[NODES])
{
    return (com[1] - com[0]) / p->period - 0.5f * p->period * pendulum_rate(p, 0) * (com[0] - zmp[0]);
}
#endif

static float last_velocity(const pendulum *p, const float com[NODES], const float zmp[NODES])
{
    const int n = NODES - 1;
    return (com[n] - com[n - 1]) / p->period + 0.5f * p->period * pendulum_rate(p, n) * (com[n] - zmp[n]);
}

/* Solve for the CoM. At the end either its position is given, or its divergent component. */
static void solve_com(
    const pendulum *p, const float zmp[NODES], float start, float end, int ends_with_divergent, float com[NODES])
{
    const float step = p->period * sqrtf(pendulum_rate(p, NODES - 1));
    float upper[NODES], lower, diag, weight, pivot;
    int i;
    com[0] = start;
    upper[0] = 0.0f;
    for (i = 1; i < NODES - 1; ++i) {
        weight = -1.0f / (pendulum_rate(p, i) * p->period * p->period);
        pivot = 1.0f - 2.0f * weight - weight * upper[i - 1];
        upper[i] = weight / pivot;
        com[i] = (zmp[i] - weight * com[i - 1]) / pivot;
    }
    if (ends_with_divergent) {
        lower = -1.0f / step;
        diag = 1.0f + 1.0f / step + 0.5f * step;
        end += 0.5f * step * zmp[NODES - 1];
    } else {
        lower = 0.0f;
        diag = 1.0f;
    }
    com[NODES - 1] = (end - lower * com[NODES - 2]) / (diag - lower * upper[NODES - 2]);
    for (i = NODES - 2; i >= 0; --i) {
        com[i] -= upper[i] * com[i + 1];
    }
}

/* Shares of the start, the support foot and the end in the ZMP reference. */
static void zmp_shares(const float params[10], int node, float shares[3])
{
    float half = 0.5f * params[DOUBLE_SUPPORT] / params[STEP_DURATION];
    const float phase = (float)node / INTERVALS;
    float away, towards;
    half = half > 1e-6f ? half : 1e-6f;
    away = clip(phase / half, 0.0f, 1.0f);
    towards = clip((phase - (1.0f - half)) / half, 0.0f, 1.0f);
    shares[0] = 1.0f - away;
    shares[1] = away - towards;
    shares[2] = towards;
}

static void zmp_reference(const float params[10], float start, float middle, float end, float zmp[NODES])
{
    int i;
    for (i = 0; i < NODES; ++i) {
        float shares[3];
        zmp_shares(params, i, shares);
        zmp[i] = shares[0] * start + shares[1] * middle + shares[2] * end;
    }
}

static void plan_com(
    walk_state *state, const walk_stance *before, const float wanted[3], const float position[2],
    const float velocity[2])
{
    const float *params = state->params;
    pendulum p;
    float zmp[NODES], com[NODES];
    int axis, i;
    make_pendulum(params, &p);
#if IS_ONE_STEP
    (void)wanted;
    (void)position;
    (void)velocity;
    for (axis = 0; axis < 2; ++axis) {
        const float middle =
            state->stage == WALK_WALKING ? state->footstep.support[axis] : before->body[axis];
        zmp_reference(params, before->body[axis], middle, state->after.body[axis], zmp);
        solve_com(&p, zmp, before->body[axis], state->after.body[axis], 0, com);
        for (i = 0; i < NODES; ++i) {
            state->com[i][axis] = com[i];
        }
        state->com_velocity[axis] = last_velocity(&p, com, zmp);
    }
#else
    {
        const int wants = wanted[0] != 0.0f || wanted[1] != 0.0f || wanted[2] != 0.0f;
        const int rests = state->stage != WALK_STARTING
            && (state->stage != WALK_WALKING || (!wants && is_side_by_side(&state->after)));
        const float omega = sqrtf(pendulum_rate(&p, NODES - 1));
        walk_footstep following;
        walk_stance then;
        next_footstep(params, &state->after, wanted, &following, &then);
        for (axis = 0; axis < 2; ++axis) {
            const float end = state->after.body[axis];
            const float middle =
                state->stage == WALK_WALKING ? state->footstep.support[axis] : before->body[axis];
            float end_velocity = 0.0f, change[NODES], shape[NODES], shift;
            if (!rests) {
                zmp_reference(params, end, following.support[axis], then.body[axis], zmp);
                solve_com(&p, zmp, end, then.body[axis], 0, com);
                end_velocity = first_velocity(&p, com, zmp);
            }
            zmp_reference(params, before->body[axis], middle, end, zmp);
            zmp_reference(params, 0.0f, 1.0f, 0.0f, shape);
            solve_com(&p, zmp, position[axis], end + end_velocity / omega, 1, com);
            solve_com(&p, shape, 0.0f, 0.0f, 1, change);
            shift = (velocity[axis] - first_velocity(&p, com, zmp)) / first_velocity(&p, change, shape);
            shift = clip(shift, -LARGEST_SHIFT[axis], LARGEST_SHIFT[axis]);
            for (i = 0; i < NODES; ++i) {
                com[i] += shift * change[i];
                zmp[i] += shift * shape[i];
                state->com[i][axis] = com[i];
            }
            state->com_velocity[axis] = last_velocity(&p, com, zmp);
        }
    }
#endif
}

/* ---- the walker ---- */

static void stand_in_place(walk_state *state, const walk_stance *stance)
{
    int i;
    state->footstep.supports_left = stance->supports_left;
    copy3(state->footstep.support, stance->supports_left ? stance->left : stance->right);
    copy3(state->footstep.swing_start, stance->supports_left ? stance->right : stance->left);
    copy3(state->footstep.swing_end, state->footstep.swing_start);
    state->after = *stance;
    for (i = 0; i < NODES; ++i) {
        state->com[i][0] = stance->body[0];
        state->com[i][1] = stance->body[1];
    }
    state->yaw[0] = state->yaw[1] = stance->body[2];
}

static int next_stage(int stage, int wants, int rests)
{
    const int first = IS_ONE_STEP ? WALK_WALKING : WALK_STARTING;
    const int last = IS_ONE_STEP ? WALK_STANDING : WALK_STOPPING;
    if (stage == WALK_STANDING || stage == WALK_STOPPING) {
        return wants ? first : WALK_STANDING;
    }
    return stage == WALK_WALKING && rests ? last : WALK_WALKING;
}

/* Plan the next step, in the frame of the body at its start. */
static void begin_step(walk_state *state, const float command[3], float measured_yaw)
{
    const int wants = command[0] != 0.0f || command[1] != 0.0f || command[2] != 0.0f;
    const float body[3] = {state->after.body[0], state->after.body[1], state->after.body[2]};
    const float com_end[3] = {state->com[NODES - 1][0], state->com[NODES - 1][1], body[2]};
    const float turn[3] = {0.0f, 0.0f, body[2]};
    const float velocity_end[3] = {state->com_velocity[0], state->com_velocity[1], body[2]};
    float position[3], velocity[3], step[3], wanted[3], origin[3], error;
    walk_stance before;
    int i;

    relative_pose(body, com_end, position);
    relative_pose(turn, velocity_end, velocity);
    for (i = 0; i < 3; ++i) {
        before.body[i] = 0.0f;
    }
    relative_pose(body, state->after.left, before.left);
    relative_pose(body, state->after.right, before.right);
    before.supports_left = state->after.supports_left;
    copy3(before.step, state->after.step);

    read_gait(command, state->params, step);
    for (i = 0; i < 3; ++i) {
        wanted[i] = wants ? step[i] : 0.0f;
    }
    state->stage = next_stage(state->stage, wants, !wants && is_side_by_side(&before));
    stand_in_place(state, &before);
    if (state->stage == WALK_WALKING) {
        next_footstep(state->params, &before, wanted, &state->footstep, &state->after);
    }
    plan_com(state, &before, wanted, position, velocity);
    state->yaw[0] = before.body[2];
    state->yaw[1] = state->after.body[2];
    compose(state->origin, body, origin);
    error = clip(wrapped(origin[2] - measured_yaw), -MAX_HEADING_ERROR, MAX_HEADING_ERROR);
    origin[2] = wrapped(measured_yaw + error);
    copy3(state->origin, origin);
}

typedef struct {
    float hips[4], left[4], right[4], turn;
} body_pose;

static void above_floor(const float foot[3], float height, float result[4])
{
    result[0] = foot[0] - ZMP_AHEAD_OF_ANKLE * cosf(foot[2]);
    result[1] = foot[1] - ZMP_AHEAD_OF_ANKLE * sinf(foot[2]);
    result[2] = height;
    result[3] = foot[2];
}

static void pose_body(const walk_state *state, body_pose *pose)
{
    const float *params = state->params;
    const int is_stepping = state->stage == WALK_WALKING;
    const float phase = clip(state->time / params[STEP_DURATION], 0.0f, 1.0f);
    const float share = params[DOUBLE_SUPPORT] / params[STEP_DURATION];
    const float swing_phase = clip((phase - 0.5f * share) / (1.0f - share), 0.0f, 1.0f);
    const float swung = smooth_step(swing_phase), turned = smooth_step(phase), node = phase * INTERVALS;
    const float lift = (is_stepping ? params[SWING_HEIGHT] : 0.0f)
        * smooth_step(1.0f - fabsf(2.0f * swing_phase - 1.0f));
    const float height = params[HIP_HEIGHT] + params[AMPLITUDE] * cosf(2.0f * PI * phase) + ANKLE_HEIGHT;
    const float yaw = (1.0f - turned) * state->yaw[0] + turned * state->yaw[1];
    float foot[3], com[2], remainder;
    int index = (int)node, i;
    index = index < NODES - 2 ? index : NODES - 2;
    remainder = node - (float)index;
    for (i = 0; i < 2; ++i) {
        com[i] = (1.0f - remainder) * state->com[index][i] + remainder * state->com[index + 1][i];
    }
    for (i = 0; i < 3; ++i) {
        foot[i] = state->footstep.swing_start[i]
            + swung * (state->footstep.swing_end[i] - state->footstep.swing_start[i]);
    }
    pose->hips[0] = com[0] - COM_AHEAD_OF_HIP * cosf(yaw);
    pose->hips[1] = com[1] - COM_AHEAD_OF_HIP * sinf(yaw);
    pose->hips[2] = height;
    pose->hips[3] = yaw;
    above_floor(foot, lift, state->footstep.supports_left ? pose->right : pose->left);
    above_floor(state->footstep.support, 0.0f, state->footstep.supports_left ? pose->left : pose->right);
    pose->turn = state->footstep.supports_left ? 0.5f - swung : swung - 0.5f;
    if (!is_stepping) {
        pose->turn = 0.0f;
    }
}

/* The pose of a sole in the frame of a trunk that leans about the middle of its hips. */
static void sole_in_torso(
    const float hips[4], const float foot[4], const matrix *trunk_level, float turn, float share,
    const float shift[2], sole_pose *sole)
{
    const matrix heading = rotation_z(turn - hips[3]), yaw = rotation_z(foot[3]);
    const float offset[3] = {foot[0] - hips[0], foot[1] - hips[1], foot[2] - hips[2]};
    float level[3];
    rotated(&heading, offset, level);
    level[0] += share * shift[0];
    level[1] += share * shift[1];
    rotated(trunk_level, level, sole->position);
    sole->position[0] += HIP_CENTRE[0];
    sole->position[2] += HIP_CENTRE[1];
    sole->rotation = product(trunk_level, &heading);
    sole->rotation = product(&sole->rotation, &yaw);
}

/* Compute the joint targets; `last` are those of one period before, NULL if there are none. */
static void pose_joints(
    const walk_state *state, const body_pose *pose, const float measured[3], const float last[], float joints[])
{
    const float *params = state->params;
    const float roll_seen = clip(measured[0], -MAX_MEASURED, MAX_MEASURED);
    const float pitch_seen = clip(measured[1], -MAX_MEASURED, MAX_MEASURED);
    const float roll = roll_seen + params[ROLL_GAIN] * (0.0f - roll_seen);
    const float pitch = pitch_seen + params[TILT_GAIN] * (params[LEAN] - pitch_seen);
    const float error = clip(wrapped(pose->hips[3] - measured[2]), -1.0f, 1.0f);
    const float turn = clip(HEADING_GAIN * error, -MAX_HEADING_STEP, MAX_HEADING_STEP) * pose->turn;
    const float roll_error = clip(measured[0], -MAX_TILT, MAX_TILT);
    const float pitch_error = clip(measured[1] - params[LEAN], -MAX_TILT, MAX_TILT);
    const float shift[2] = {
        FORWARD_PLACEMENT_GAIN * params[HIP_HEIGHT] * pitch_error, -PLACEMENT_GAIN * params[HIP_HEIGHT] * roll_error};
    const float ahead = 0.5f * (cosf(pose->hips[3]) * (pose->left[0] - pose->right[0])
        + sinf(pose->hips[3]) * (pose->left[1] - pose->right[1]));
    const matrix about_x = rotation_x(roll), about_y = rotation_y(pitch);
    const matrix level_trunk = product(&about_y, &about_x), trunk_level = transposed(&level_trunk);
    sole_pose soles[2];
    int i;

    sole_in_torso(pose->hips, pose->left, &trunk_level, turn, 0.5f + pose->turn, shift, &soles[0]);
    sole_in_torso(pose->hips, pose->right, &trunk_level, -turn, 0.5f - pose->turn, shift, &soles[1]);
    for (i = 0; i < WALK_NUM_JOINTS; ++i) {
        joints[i] = POSTURE[i] + ARM_SWING[i] * ahead;
    }
    solve_legs(soles, last, joints);
    for (i = 0; i < WALK_NUM_JOINTS; ++i) {
        joints[i] = clip(joints[i], JOINT_LOW[i], JOINT_HIGH[i]);
    }
}

/* Fit a line to all measurements of an angle, whose weights fall exponentially with their age. */
static void filter_tilt(float *angle, float *rate, float measured)
{
    const float memory = FILTER_MEMORY, forgotten = 1.0f - memory;
    const float predicted = *angle + WALK_PERIOD * *rate;
    float surprise;
    if (!isfinite(measured)) {
        /* A missing measurement: the angle stays, and the rate fades. */
        *rate *= memory;
        return;
    }
    surprise = clip(measured, -MAX_MEASURED, MAX_MEASURED) - predicted;
    *angle = predicted + (1.0f - memory * memory) * surprise;
    *rate += forgotten * forgotten / WALK_PERIOD * surprise;
}

static void write_out(const walk_state *state, float out[WALK_NUM_JOINTS])
{
    int i;
    for (i = 0; i < WALK_NUM_JOINTS; ++i) {
        out[i] = OUT_SIGN[i] * state->set_point[i];
    }
}

void walk_start(walk_state *state, float out[WALK_NUM_JOINTS])
{
    walk_stance stance;
    body_pose pose;
    float upright[3], step[3];
    int i;
    for (i = 0; i < 3; ++i) {
        stance.body[i] = stance.left[i] = stance.right[i] = stance.step[i] = 0.0f;
        state->origin[i] = state->command[i] = 0.0f;
    }
    stance.left[1] = 0.5f * FOOT_SPACING;
    stance.right[1] = -0.5f * FOOT_SPACING;
    stance.supports_left = 1;
    state->stage = WALK_STANDING;
    state->time = 0.0f;
    state->com_velocity[0] = state->com_velocity[1] = 0.0f;
    read_gait(state->command, state->params, step);
    stand_in_place(state, &stance);
    state->tilt[0] = state->tilt_rate[0] = state->tilt_rate[1] = 0.0f;
    state->tilt[1] = state->params[LEAN];
    upright[0] = state->tilt[0];
    upright[1] = state->tilt[1];
    upright[2] = 0.0f;
    pose_body(state, &pose);
    pose_joints(state, &pose, upright, NULL, state->set_point);
    write_out(state, out);
}

void walk_step(
    walk_state *state, const float command[3], float roll, float pitch, float yaw, float out[WALK_NUM_JOINTS])
{
    float limited[3], measured[3], target[WALK_NUM_JOINTS];
    const int was_standing = state->stage == WALK_STANDING;
    body_pose pose;
    int is_over, i;
    /* A missing yaw: the robot heads as planned. */
    if (!isfinite(yaw)) {
        const float turned = smooth_step(state->time / state->params[STEP_DURATION]);
        yaw = state->origin[2] + (1.0f - turned) * state->yaw[0] + turned * state->yaw[1];
    }
    filter_tilt(&state->tilt[0], &state->tilt_rate[0], roll);
    filter_tilt(&state->tilt[1], &state->tilt_rate[1], pitch);
    for (i = 0; i < 3; ++i) {
        const float limit = WALK_PERIOD * ACCELERATION[i];
        /* What is not finite counts as zero: the robot stops. */
        const float wanted = isfinite(command[i]) ? command[i] : 0.0f;
        limited[i] = state->command[i] + clip(wanted - state->command[i], -limit, limit);
    }
    if (was_standing) {
        is_over = limited[0] != 0.0f || limited[1] != 0.0f || limited[2] != 0.0f;
        state->time = is_over ? WALK_PERIOD : 0.0f;
    } else {
        state->time += WALK_PERIOD;
        is_over = state->time >= state->params[STEP_DURATION];
        state->time -= is_over ? state->params[STEP_DURATION] : 0.0f;
    }
    if (is_over) {
        begin_step(state, limited, yaw);
    }
    copy3(state->command, limited);
    measured[0] = state->tilt[0];
    measured[1] = state->tilt[1];
    measured[2] = wrapped(yaw - state->origin[2]);
    pose_body(state, &pose);
    pose_joints(state, &pose, measured, state->set_point, target);
    for (i = 0; i < WALK_NUM_JOINTS; ++i) {
        const float farthest = MAX_JOINT_SPEED[i] * WALK_PERIOD;
        state->set_point[i] += clip(target[i] - state->set_point[i], -farthest, farthest);
    }
    write_out(state, out);
}
