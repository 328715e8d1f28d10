/* A model predictive controller for the machine: see README.md.
 *
 * One controller, in static memory: nothing is allocated, and no two threads may be in here at once.
 * Call mpc_init once, then mpc_step in every period.
 */
#ifndef MPC_H
#define MPC_H

#ifdef __cplusplus
extern "C" {
#endif

#define MPC_NX @NX@                  /* states */
#define MPC_NU @NU@                  /* inputs */
#define MPC_HORIZON @HORIZON@             /* steps that the controller looks ahead */
#define MPC_PERIOD @PERIOD@             /* seconds between two steps */
#define MPC_LARGEST_ITERATIONS @ITERATIONS@ /* a step never takes more */
#define MPC_TOLERANCE @TOLERANCE@         /* "solved" is said of a residual up to this */
@HAS_REFERENCE@
@HAS_DISTURBANCE@
@HAS_BEFORE@
typedef @FLOAT@ mpc_float;

typedef enum {
    MPC_SOLVED = 0,         /* u is set: the residual was computed, and is small enough */
    MPC_INFEASIBLE = 1,     /* no plan keeps to the constraints, by a proof that was checked */
    MPC_MAX_ITERATIONS = 2, /* the largest number of iterations did not suffice */
    MPC_FAILED = 3,         /* the numbers leave what can be computed */
    MPC_BAD_INPUT = 4       /* NaN or infinity came in, or a set point that cannot be held */
} mpc_status;

#if defined(__GNUC__)
#define MPC_LOOK_AT_IT __attribute__((warn_unused_result))
#else
#define MPC_LOOK_AT_IT
#endif

/* Start afresh: no plan, the set point at the origin. */
void mpc_init(void);

/* Find the input u (MPC_NU) for the state x (MPC_NX), in the units of the model.
 *
 * u is written if and only if the status is MPC_SOLVED: what to do without an answer (hold the last
 * input, brake, hand over) is the caller's to decide, and never a number that was made up.
 * Starts from the plan of the step before. */
mpc_status mpc_step(const mpc_float *x, mpc_float *u) MPC_LOOK_AT_IT;

#if MPC_HAS_REFERENCE
/* From the next step on, steer to x_r (MPC_NX), u_r (MPC_NU), which must be a steady state within the
 * constraints: MPC_BAD_INPUT if it is not, and the old one stays. */
mpc_status mpc_reference(const mpc_float *x_r, const mpc_float *u_r) MPC_LOOK_AT_IT;
#endif

#if MPC_HAS_DISTURBANCE
/* From the next step on, d (MPC_NX) is added to every next state. A set point is steady under the
 * disturbance at hand: set that first. */
mpc_status mpc_disturbance(const mpc_float *d) MPC_LOOK_AT_IT;
#endif

#if MPC_HAS_BEFORE
/* The plant received u (MPC_NU), and not what mpc_step found: increments are counted from there. At
 * first, and after mpc_init, from 0. */
mpc_status mpc_before(const mpc_float *u) MPC_LOOK_AT_IT;
#endif

/* Of the last step: the status, the iterations, and how far from optimal the plan is. */
mpc_status mpc_last_status(void);
int mpc_last_iterations(void);
mpc_float mpc_last_residual(void);

#ifdef __cplusplus
}
#endif

#endif
