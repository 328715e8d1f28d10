/* Replays closed loops that were recorded in Python, and prints what is different here. */
#include <stdio.h>
#include <time.h>

#include "loop.h"
#include "mpc.h"

static double size_of(double value) { return value < 0 ? -value : value; }

int main(void)
{
    double x[MPC_NX], next[MPC_NX], worst_u = 0, worst_x = 0, seconds = 0, longest = 0;
    mpc_float here[MPC_NX], u[MPC_NU];
    long total = 0;
    int run, step, i, j, worst = 0, unsolved = 0, k = 0;
    mpc_init();
#if MPC_HAS_REFERENCE && LOOP_REFERENCE
    {
        mpc_float x_r[MPC_NX], u_r[MPC_NU];
        for (i = 0; i < MPC_NX; i++) {
            x_r[i] = (mpc_float)loop_x_r[i];
        }
        for (i = 0; i < MPC_NU; i++) {
            u_r[i] = (mpc_float)loop_u_r[i];
        }
        if (mpc_reference(x_r, u_r) != MPC_SOLVED) {
            printf("the set point is refused\n");
            return 1;
        }
    }
#endif
    for (run = 0; run < LOOP_RUNS; run++) {
        for (i = 0; i < MPC_NX; i++) {
            x[i] = loop_x[k][i];
        }
        for (step = 0; step < LOOP_STEPS; step++, k++) {
            clock_t began;
            double took;
            for (i = 0; i < MPC_NX; i++) {
                here[i] = (mpc_float)x[i];
                if (size_of(x[i] - loop_x[k][i]) > worst_x) {
                    worst_x = size_of(x[i] - loop_x[k][i]);
                }
            }
            began = clock();
            if (mpc_step(here, u) != MPC_SOLVED) {
                unsolved++;
                for (i = 0; i < MPC_NU; i++) {
                    u[i] = (mpc_float)loop_u[k][i]; /* go on with what Python did */
                }
            }
            took = (double)(clock() - began) / CLOCKS_PER_SEC;
            seconds += took;
            longest = took > longest ? took : longest;
            total += mpc_last_iterations();
            worst = mpc_last_iterations() > worst ? mpc_last_iterations() : worst;
            for (i = 0; i < MPC_NU; i++) {
                if (size_of((double)u[i] - loop_u[k][i]) > worst_u) {
                    worst_u = size_of((double)u[i] - loop_u[k][i]);
                }
            }
            for (i = 0; i < MPC_NX; i++) {
                next[i] = 0;
                for (j = 0; j < MPC_NX; j++) {
                    next[i] += loop_A[i][j] * x[j];
                }
                for (j = 0; j < MPC_NU; j++) {
                    next[i] += loop_B[i][j] * (double)u[j];
                }
            }
            for (i = 0; i < MPC_NX; i++) {
                x[i] = next[i];
            }
        }
    }
    printf("steps %d\n", k);
    printf("not solved %d\n", unsolved);
    printf("largest difference of an input %.3g\n", worst_u);
    printf("largest difference of a state %.3g\n", worst_x);
    printf("iterations %.1f on average, %d at most of %d\n", (double)total / k, worst,
           MPC_LARGEST_ITERATIONS);
    printf("microseconds %.1f on average, %.0f at most\n", 1e6 * seconds / k, 1e6 * longest);
    return unsolved || !(worst_u <= LOOP_ALLOWED);
}
