/* The controller: prepares the quadratic program of a step, has OSQP solve it, judges the answer. */
#include "mpc.h"
#include "mpc_data.h"

#include "osqp.h"

#include "types.h"
#include "algebra_impl.h"
#include "mpc_osqp_workspace.h"

/* The numbers that the program depends on: the state, then the set point if there can be one. */
static mpc_float p[DATA_P];
static mpc_float q[DATA_N], lower[DATA_M], upper[DATA_M];
static mpc_float slope[DATA_N], pull[DATA_N], at[DATA_M];

static mpc_status status = MPC_BAD_INPUT;
static int iterations = 0;
static mpc_float residual = 0;

static mpc_float size_of(mpc_float value) { return value < 0 ? -value : value; }

static mpc_float larger(mpc_float a, mpc_float b) { return a > b ? a : b; }

static int finite(const mpc_float *values, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        if (!(values[i] - values[i] == 0)) {
            return 0;
        }
    }
    return 1;
}

/* A row of a sparse matrix times a vector, or the sum of the sizes of its terms. */
static mpc_float product(const data_matrix *m, int row, const mpc_float *v)
{
    mpc_float sum = 0;
    int k;
    for (k = m->start[row]; k < m->start[row + 1]; k++) {
        sum += m->value[k] * v[m->column[k]];
    }
    return sum;
}

#if DATA_FIXED || MPC_HAS_REFERENCE
static mpc_float sizes(const data_matrix *m, int row, const mpc_float *v)
{
    mpc_float sum = 0;
    int k;
    for (k = m->start[row]; k < m->start[row + 1]; k++) {
        sum += size_of(m->value[k] * v[m->column[k]]);
    }
    return sum;
}
#endif

/* Whether the state breaks a constraint that no input moves, at once or some steps later. */
static int hopeless(void)
{
#if DATA_FIXED
    int i;
    for (i = 0; i < DATA_FIXED; i++) {
        mpc_float near = larger(data_fixed_size[i], sizes(&data_fixed, i, p));
        if (product(&data_fixed, i, p) - data_fixed_limit[i] > DATA_ON_LIMIT * near) {
            return 1;
        }
    }
#endif
    return 0;
}

/* pull = A'y, and at = A z if z is given. */
static void along_rows(const mpc_float *z, const mpc_float *y)
{
    const OSQPCscMatrix *A = mpc_osqp_solver.work->data->A->csc;
    int j, k;
    for (j = 0; z && j < DATA_M; j++) {
        at[j] = 0;
    }
    for (j = 0; j < DATA_N; j++) {
        pull[j] = 0;
        for (k = A->p[j]; k < A->p[j + 1]; k++) {
            pull[j] += A->x[k] * y[A->i[k]];
            if (z) {
                at[A->i[k]] += A->x[k] * z[j];
            }
        }
    }
}

/* The largest violation of the optimality conditions, relative to the sizes of their terms. */
static mpc_float violation(const mpc_float *z, const mpc_float *y)
{
    const OSQPCscMatrix *P = mpc_osqp_solver.work->data->P->csc;
    mpc_float terms = 1, wrong = 0, rows = 1, beyond = 0;
    int i, j, k;
    if (!finite(z, DATA_N) || !finite(y, DATA_M)) {
        return DATA_INFINITE;
    }
    along_rows(z, y);
    for (j = 0; j < DATA_N; j++) {
        slope[j] = 0;
    }
    for (j = 0; j < DATA_N; j++) { /* the upper triangle */
        for (k = P->p[j]; k < P->p[j + 1]; k++) {
            i = P->i[k];
            slope[i] += P->x[k] * z[j];
            if (i != j) {
                slope[j] += P->x[k] * z[i];
            }
        }
    }
    for (j = 0; j < DATA_N; j++) {
        terms = larger(larger(terms, size_of(q[j])), larger(size_of(slope[j]), size_of(pull[j])));
        wrong = larger(wrong, size_of(slope[j] + q[j] + pull[j]));
    }
    for (i = 0; i < DATA_M; i++) {
        /* A row is within its limits, and its multiplier pushes only at one. */
        mpc_float to = at[i] + y[i];
        to = to < lower[i] ? lower[i] : to > upper[i] ? upper[i] : to;
        rows = larger(rows, size_of(at[i]));
        beyond = larger(beyond, size_of(at[i] - to));
    }
    if (!finite(slope, DATA_N) || !finite(pull, DATA_N) || !finite(at, DATA_M)) {
        return DATA_INFINITE;
    }
    return larger(wrong / terms, beyond / rows);
}

/* What y lacks as a proof that there is no plan: all with |z| < 1 / doubt are ruled out. */
static mpc_float doubt(mpc_float *y)
{
    mpc_float gap = 0, left = 0;
    int i;
    if (!finite(y, DATA_M)) {
        return DATA_INFINITE;
    }
    for (i = 0; i < DATA_M; i++) {
        if (y[i] > 0 ? upper[i] >= DATA_INFINITE : lower[i] <= -DATA_INFINITE) {
            y[i] = 0; /* of no limit: rounding */
        }
        gap -= y[i] * (y[i] > 0 ? upper[i] : lower[i]);
    }
    along_rows(0, y);
    for (i = 0; i < DATA_N; i++) {
        left += size_of(pull[i]);
    }
    return gap > 0 && gap - gap == 0 ? left / gap : DATA_INFINITE;
}

static mpc_status ended(mpc_status how)
{
    status = how;
    if (how != MPC_SOLVED) {
        osqp_cold_start(&mpc_osqp_solver);
    }
    return how;
}

void mpc_init(void)
{
    int i;
    for (i = 0; i < DATA_P; i++) {
        p[i] = 0;
    }
    iterations = 0;
    residual = DATA_INFINITE;
    (void)ended(MPC_BAD_INPUT); /* nothing has come in yet */
}

mpc_status mpc_step(const mpc_float *x, mpc_float *u)
{
    const OSQPSolution *found = mpc_osqp_solver.solution;
    int i, said;
    iterations = 0;
    residual = DATA_INFINITE;
    if (!finite(x, MPC_NX)) {
        return ended(MPC_BAD_INPUT);
    }
    for (i = 0; i < MPC_NX; i++) {
        p[i] = x[i];
    }
    if (hopeless()) {
        return ended(MPC_INFEASIBLE);
    }
    for (i = 0; i < DATA_N; i++) {
        q[i] = data_q0[i] + product(&data_q, i, p);
    }
    for (i = 0; i < DATA_M; i++) {
        mpc_float shift = product(&data_limits, i, p);
        lower[i] = data_lower[i] <= -DATA_INFINITE ? -DATA_INFINITE : data_lower[i] + shift;
        upper[i] = data_upper[i] >= DATA_INFINITE ? DATA_INFINITE : data_upper[i] + shift;
    }
    if (!finite(q, DATA_N) || !finite(lower, DATA_M) || !finite(upper, DATA_M)
        || osqp_update_data_vec(&mpc_osqp_solver, q, lower, upper)
        || osqp_solve(&mpc_osqp_solver)) {
        return ended(MPC_FAILED);
    }
    iterations = (int)mpc_osqp_solver.info->iter;
    said = (int)mpc_osqp_solver.info->status_val;
    if (said == OSQP_PRIMAL_INFEASIBLE || said == OSQP_PRIMAL_INFEASIBLE_INACCURATE) {
        /* Embedded, OSQP leaves its proof here. */
        residual = doubt(mpc_osqp_solver.work->delta_y->values);
        return ended(residual <= DATA_PROVEN ? MPC_INFEASIBLE : MPC_FAILED);
    }
    if (said != OSQP_SOLVED && said != OSQP_SOLVED_INACCURATE && said != OSQP_MAX_ITER_REACHED) {
        return ended(MPC_FAILED);
    }
    /* Whatever the solver says, the answer is judged by its own residual. */
    residual = violation(found->x, found->y);
    if (!(residual <= (mpc_float)MPC_TOLERANCE)) {
        return ended(said == OSQP_MAX_ITER_REACHED ? MPC_MAX_ITERATIONS : MPC_FAILED);
    }
    for (i = 0; i < MPC_NU; i++) {
        mpc_float value = product(&data_from_plan, i, found->x) + product(&data_from_state, i, p);
        u[i] = value < data_u_min[i] ? data_u_min[i] : value > data_u_max[i] ? data_u_max[i] : value;
    }
#if MPC_HAS_BEFORE
    for (i = 0; i < MPC_NU; i++) {
        p[DATA_BEFORE + i] = u[i];
    }
#endif
    return ended(MPC_SOLVED);
}

#if MPC_HAS_REFERENCE
mpc_status mpc_reference(const mpc_float *x_r, const mpc_float *u_r)
{
    mpc_float z[MPC_NX + MPC_NU], far = 0;
    int i;
    if (!finite(x_r, MPC_NX) || !finite(u_r, MPC_NU)) {
        return MPC_BAD_INPUT;
    }
    for (i = 0; i < MPC_NX; i++) {
        z[i] = x_r[i];
    }
    for (i = 0; i < MPC_NU; i++) {
        z[MPC_NX + i] = u_r[i];
    }
    for (i = 0; i < MPC_NX + MPC_NU; i++) {
        far = larger(far, size_of(z[i]) / data_units[i]);
    }
    for (i = 0; i < MPC_NX; i++) { /* the next state is the same */
        mpc_float near = larger(far * data_units[i], sizes(&data_drift, i, z));
        mpc_float drift = product(&data_drift, i, z);
#if MPC_HAS_DISTURBANCE
        drift += p[DATA_DISTURBANCE + i];
        near = larger(near, size_of(p[DATA_DISTURBANCE + i]));
#endif
        if (!(size_of(drift) <= DATA_REACHED * near)) {
            return MPC_BAD_INPUT;
        }
    }
    for (i = 0; i < DATA_SETS; i++) {
        mpc_float room = DATA_REACHED * larger(size_of(data_sets_limit[i]), sizes(&data_sets, i, z));
        if (!(product(&data_sets, i, z) <= data_sets_limit[i] + room)) {
            return MPC_BAD_INPUT;
        }
    }
    for (i = 0; i < MPC_NX + MPC_NU; i++) {
        p[MPC_NX + i] = z[i];
    }
    return MPC_SOLVED;
}
#endif

#if MPC_HAS_DISTURBANCE || MPC_HAS_BEFORE
static mpc_status taken(const mpc_float *values, int first, int count)
{
    int i;
    if (!finite(values, count)) {
        return MPC_BAD_INPUT;
    }
    for (i = 0; i < count; i++) {
        p[first + i] = values[i];
    }
    return MPC_SOLVED;
}
#endif

#if MPC_HAS_DISTURBANCE
mpc_status mpc_disturbance(const mpc_float *d) { return taken(d, DATA_DISTURBANCE, MPC_NX); }
#endif

#if MPC_HAS_BEFORE
mpc_status mpc_before(const mpc_float *u) { return taken(u, DATA_BEFORE, MPC_NU); }
#endif

mpc_status mpc_last_status(void) { return status; }

int mpc_last_iterations(void) { return iterations; }

mpc_float mpc_last_residual(void) { return residual; }
