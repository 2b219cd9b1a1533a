/* A learned walk of the robot @ROBOT@: from commanded speeds to joint set-points, by creps_jax @VERSION@.
 *
 *     walk_state state;
 *     float out[WALK_NUM_JOINTS];
 *     const float command[3] = {0.3f, 0.0f, 0.0f};
 *     walk_start(&state, out);
 *     every WALK_PERIOD seconds: walk_step(&state, command, roll, pitch, yaw, out);
 *
 * The robot stands when it starts, and stops with its feet side by side at the command zero. C99 or C++.
 */
#ifndef WALK_H
#define WALK_H

#ifdef __cplusplus
extern "C" {
#endif

#define WALK_NUM_JOINTS @NUM_JOINTS@
#define WALK_NUM_NODES @NUM_NODES@
/* Time between two calls of walk_step, s. */
#define WALK_PERIOD @PERIOD@
/* Commands are limited to these: forward and to the left (m/s), turn rate (rad/s). */
@RANGES@

enum { WALK_STANDING, WALK_STARTING, WALK_WALKING, WALK_STOPPING };

/* Planar poses are x, y (m) and yaw (rad). */
typedef struct {
    float body[3], left[3], right[3], step[3];
    int supports_left;
} walk_stance;

typedef struct {
    float support[3], swing_start[3], swing_end[3];
    int supports_left;
} walk_footstep;

typedef struct {
    int stage;                         /* WALK_STANDING, ... */
    float time;                        /* since the start of the present step, s */
    float origin[3];                   /* planned pose of the body at the start of the step, in the world */
    float command[3];                  /* present command, limited by the acceleration */
    float params[10];                  /* walking parameters of the step, SI units */
    walk_footstep footstep;            /* of the step, in the frame of origin */
    walk_stance after;                 /* after the step, in the same frame */
    float com[WALK_NUM_NODES][2];      /* centre of mass over the step, in the same frame, m */
    float com_velocity[2];             /* at the end of the step, m/s */
    float yaw[2];                      /* of the trunk at start and end of the step, rad */
    float tilt[2], tilt_rate[2];       /* roll and pitch of the trunk, filtered, rad and rad/s */
    float set_point[WALK_NUM_JOINTS];  /* last set-points, in the order and signs of the simulation, rad */
} walk_state;

/* Names of the joints in the order of `out`, those of the robot's own software; so are the signs of `out`. */
extern const char *const walk_joint_names[WALK_NUM_JOINTS];

/* Begin: `out` is the posture in which the robot stands, rad. */
void walk_start(walk_state *state, float out[WALK_NUM_JOINTS]);

/* Walk on by one period.
 *
 * command: wanted speed forward and to the left (m/s) and turn rate (rad/s); it is followed with limited
 *     acceleration.
 * roll, pitch, yaw: measured orientation of the trunk, rad: roll to the right and pitch forward are positive;
 *     yaw to the left, of any turn. NAN where a measurement is missing: roll and pitch stay as they were, and
 *     the heading counts as planned. A command that is not finite counts as zero. Both need a build without
 *     -ffast-math.
 * out: joint set-points for the end of the period, rad.
 */
void walk_step(
    walk_state *state, const float command[3], float roll, float pitch, float yaw, float out[WALK_NUM_JOINTS]);

#ifdef __cplusplus
}
#endif

#endif
