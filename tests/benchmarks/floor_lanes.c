/* The floor of tests/benchmarks/ensemble.py: many plants of one closed loop (gouta2015, backstepping as printed), as a C programmer who knows
   vector units would write them. Struct of arrays: every state and coefficient is a row of LANES doubles, the lanes are the inner loop, and a
   block of LANES stays in registers and L1 for the whole run. Arithmetic, order of operations and running measures are those of
   tuning/floor.c, which runs one plant at a time; the references are shared. gcc -O3 -march=native -mprefer-vector-width=512, without
   -ffast-math; -fno-math-errno and -fno-trapping-math change no number, they let a square root and a choice be vector instructions. */

#include <math.h>

#ifdef SINGLE /* the same in float32, its sums not compensated */
#define double float
#define sqrt sqrtf
#endif

#ifndef LANES
#define LANES 16
#endif
typedef double row[LANES] __attribute__((aligned(64)));
#define EACH for (int l = 0; l < LANES; l++)

/* jaxtank's outflow root: the square root above the knee, a laminar film below; both sides are computed, as a vector unit must */
static inline double root(double h, double knee, double slope, double bend)
{
    double film = h * (slope - bend * (h > 0.0 ? h : 0.0));
    return h >= knee ? sqrt(h) : film;
}

/* plants: rows of `count` drain1, drain2, orifice1..4, pump1, pump2; areas and law are shared. nominal: the law's own c1..c10.
   result: count rows of sum of squared errors and four highest levels. count must be a multiple of LANES. */
static inline __attribute__((always_inline)) void run(long count, const double *plants, const double *area, double gravity, double knee, const double *nominal, long n,
                double dt, const int rk4, double k, double k1, double level_floor, double high, const double *x0, const double *r,
                double *result)
{
    double w = sqrt(2.0 * gravity), slope = 1.5 / sqrt(knee), bend = 0.5 / (knee * sqrt(knee));
    const double *m = nominal;
    double alpha = 0.5 * (m[1] * m[5] - m[2] * m[4]), gain = k + k1;
    double b11 = m[5] / (alpha * m[7]), b12 = m[2] / (alpha * m[7]), b13 = m[6] / m[7];
    double b21 = m[4] / (alpha * m[9]), b22 = m[1] / (alpha * m[9]), b23 = m[8] / m[9];
    for (long first = 0; first < count; first += LANES) {
        row c[10], x[4], top[4], sum;
        EACH {
            const double *p = plants + first + l;
            c[0][l] = p[0] * w / area[0];
            c[1][l] = p[2 * count] * w / area[0];
            c[2][l] = p[4 * count] * w / area[0];
            c[3][l] = p[1 * count] * w / area[1];
            c[4][l] = p[3 * count] * w / area[1];
            c[5][l] = p[5 * count] * w / area[1];
            c[6][l] = (p[2 * count] + p[3 * count]) * w / area[2];
            c[7][l] = p[6 * count] / area[2];
            c[8][l] = (p[4 * count] + p[5 * count]) * w / area[3];
            c[9][l] = p[7 * count] / area[3];
            for (int j = 0; j < 4; j++)
                x[j][l] = x0[j], top[j][l] = -INFINITY;
            sum[l] = 0.0;
        }
        for (long i = 0; i < n; i++) {
            double r1 = r[i], r2 = r[n + i], rest1 = m[0] * sqrt(r1), rest2 = m[3] * sqrt(r2);
            EACH {
                double h1 = x[0][l], h2 = x[1][l], h3 = x[2][l], h4 = x[3][l];
                double s3 = sqrt(h3 >= level_floor ? h3 : level_floor), s4 = sqrt(h4 >= level_floor ? h4 : level_floor);
                double e1 = h1 - r1, e2 = h2 - r2;
                double v1 = -gain * (m[1] * s3 + m[2] * s4 - rest1 + k1 * e1);
                double v2 = -gain * (m[4] * s3 + m[5] * s4 - rest2 + k1 * e2);
                double u1 = s3 * (b11 * v1 - b12 * v2 + b13), u2 = s4 * (b22 * v2 - b21 * v1 + b23);
                u1 = u1 < 0.0 ? 0.0 : u1;
                u1 = u1 > high ? high : u1;
                u2 = u2 < 0.0 ? 0.0 : u2;
                u2 = u2 > high ? high : u2;
                sum[l] += e1 * e1 + e2 * e2;
                top[0][l] = h1 > top[0][l] ? h1 : top[0][l];
                top[1][l] = h2 > top[1][l] ? h2 : top[1][l];
                top[2][l] = h3 > top[2][l] ? h3 : top[2][l];
                top[3][l] = h4 > top[3][l] ? h4 : top[3][l];
                double a1, a2, a3, a4, q1, q2, q3, q4;
#define RATES(d1, d2, d3, d4, y1, y2, y3, y4)                                                                                          \
    {                                                                                                                                  \
        double z1 = root(y1, knee, slope, bend), z2 = root(y2, knee, slope, bend), z3 = root(y3, knee, slope, bend), z4 = root(y4, knee, slope, bend);             \
        d1 = c[1][l] * z3 + c[2][l] * z4 - c[0][l] * z1;                                                                               \
        d2 = c[4][l] * z3 + c[5][l] * z4 - c[3][l] * z2;                                                                               \
        d3 = c[7][l] * u1 - c[6][l] * z3;                                                                                              \
        d4 = c[9][l] * u2 - c[8][l] * z4;                                                                                              \
    }
                RATES(a1, a2, a3, a4, h1, h2, h3, h4)
                double g = 0.5 * dt;
                RATES(q1, q2, q3, q4, h1 + g * a1, h2 + g * a2, h3 + g * a3, h4 + g * a4)
                if (rk4) {
                    double b1, b2, b3, b4, d1, d2, d3, d4;
                    RATES(b1, b2, b3, b4, h1 + g * q1, h2 + g * q2, h3 + g * q3, h4 + g * q4)
                    RATES(d1, d2, d3, d4, h1 + dt * b1, h2 + dt * b2, h3 + dt * b3, h4 + dt * b4)
                    g = dt / 6.0;
                    x[0][l] = h1 + g * (a1 + 2.0 * (q1 + b1) + d1);
                    x[1][l] = h2 + g * (a2 + 2.0 * (q2 + b2) + d2);
                    x[2][l] = h3 + g * (a3 + 2.0 * (q3 + b3) + d3);
                    x[3][l] = h4 + g * (a4 + 2.0 * (q4 + b4) + d4);
                } else {
                    x[0][l] = h1 + dt * q1;
                    x[1][l] = h2 + dt * q2;
                    x[2][l] = h3 + dt * q3;
                    x[3][l] = h4 + dt * q4;
                }
            }
        }
        EACH {
            double *out = result + 5 * (first + l);
            out[0] = sum[l];
            for (int j = 0; j < 4; j++)
                out[1 + j] = top[j][l];
        }
    }
}

void four_tanks(long count, const double *plants, const double *area, double gravity, double knee, const double *nominal, long n,
                double dt, int rk4, double k, double k1, double level_floor, double high, const double *x0, const double *r,
                double *result)
{
    if (rk4) /* two copies, so that the choice is outside the loops */
        run(count, plants, area, gravity, knee, nominal, n, dt, 1, k, k1, level_floor, high, x0, r, result);
    else
        run(count, plants, area, gravity, knee, nominal, n, dt, 0, k, k1, level_floor, high, x0, r, result);
}
