#include <stdio.h>
#include <time.h>
#include "law.h"
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
int main(void)
{
    const double start[] = {${levels}}, set[] = {${setpoints}};
    double y[LAW_TANKS], r[LAW_OUTPUTS], u[LAW_PUMPS], best = 1e30, sum = 0.0;
    law_state state;
    for (int round = 0; round < ${rounds}; ++round) {
        law_init(&state, NULL, start, NULL);
        const double began = now();
        double took = 0.0;
        int k = 0;
        while (k < ${steps} && took < ${longest}) {
            for (int i = 0; i < LAW_TANKS; ++i) y[i] = start[i] * (1.0 + 0.01 * (double)(k % 7));
            const double step = 1.0 + 0.1 * (double)(k / 500 % 3);
            for (int i = 0; i < LAW_OUTPUTS; ++i) r[i] = set[i] * step;
            law_step(&state, NULL, k * law_dt, y, r, NULL, NULL, NULL, u);
            sum += u[0];
            if (++k % 50 == 0) took = now() - began;
        }
        const double one = (now() - began) / k;
        best = one < best ? one : best;
    }
    printf("%.6g %.3g\n", 1e6 * best, sum);
    return 0;
}
