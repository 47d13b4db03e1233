/* The floor of `jaxtank bench`: one closed loop of the state-coupled four-tank (gouta2015) under backstepping, written as a C
   programmer would: midpoint or RK4, outflow roots with the laminar film below the knee, clip, running sum of squared errors and maxima.
   The same arithmetic as jaxtank's scan, in float64, with the references prepared by the caller. */

#include <math.h>

static inline double root(double h, double knee, double film)
{
    if (h >= knee)
        return sqrt(h);
    double x = h / knee;
    return film * (x > 0.0 ? x * (1.5 - 0.5 * x) : 1.5 * x);
}

typedef struct {
    double area[4], drain[2], orifice[4], pump_gain[2], gravity, knee;
} plant;

static inline void rates(const double c[10], double knee, double film, const double x[4], const double u[2], double dx[4])
{
    double s1 = root(x[0], knee, film), s2 = root(x[1], knee, film), s3 = root(x[2], knee, film), s4 = root(x[3], knee, film);
    dx[0] = c[1] * s3 + c[2] * s4 - c[0] * s1;
    dx[1] = c[4] * s3 + c[5] * s4 - c[3] * s2;
    dx[2] = c[7] * u[0] - c[6] * s3;
    dx[3] = c[9] * u[1] - c[8] * s4;
}

/* r: 2 rows of n setpoints; result: sum of squared errors, then the four highest levels. Returns the rms error [cm]. */
double four_tank(const plant *p, long n, double dt, int rk4, double k, double k1, double level_floor, double high,
                 const double *x0, const double *r, double *result)
{
    double w = sqrt(2.0 * p->gravity), film = sqrt(p->knee), c[10];
    c[0] = p->drain[0] * w / p->area[0];
    c[1] = p->orifice[0] * w / p->area[0];
    c[2] = p->orifice[2] * w / p->area[0];
    c[3] = p->drain[1] * w / p->area[1];
    c[4] = p->orifice[1] * w / p->area[1];
    c[5] = p->orifice[3] * w / p->area[1];
    c[6] = (p->orifice[0] + p->orifice[1]) * w / p->area[2];
    c[7] = p->pump_gain[0] / p->area[2];
    c[8] = (p->orifice[2] + p->orifice[3]) * w / p->area[3];
    c[9] = p->pump_gain[1] / p->area[3];
    double alpha = 0.5 * (c[1] * c[5] - c[2] * c[4]), gain = k + k1, sum = 0.0;
    double b11 = c[5] / (alpha * c[7]), b12 = c[2] / (alpha * c[7]), b13 = c[6] / c[7];
    double b21 = c[4] / (alpha * c[9]), b22 = c[1] / (alpha * c[9]), b23 = c[8] / c[9];
    double x[4] = {x0[0], x0[1], x0[2], x0[3]}, top[4] = {-INFINITY, -INFINITY, -INFINITY, -INFINITY};
    for (long i = 0; i < n; i++) {
        double r1 = r[i], r2 = r[n + i], u[2];
        double s3 = sqrt(x[2] >= level_floor ? x[2] : level_floor), s4 = sqrt(x[3] >= level_floor ? x[3] : level_floor);
        double e1 = x[0] - r1, e2 = x[1] - r2;
        double v1 = -gain * (c[1] * s3 + c[2] * s4 - c[0] * sqrt(r1) + k1 * e1);
        double v2 = -gain * (c[4] * s3 + c[5] * s4 - c[3] * sqrt(r2) + k1 * e2);
        u[0] = s3 * (b11 * v1 - b12 * v2 + b13);
        u[1] = s4 * (b22 * v2 - b21 * v1 + b23);
        for (int j = 0; j < 2; j++)
            u[j] = u[j] < 0.0 ? 0.0 : (u[j] > high ? high : u[j]);
        sum += e1 * e1 + e2 * e2;
        for (int j = 0; j < 4; j++)
            top[j] = x[j] > top[j] ? x[j] : top[j];
        double q1[4], q2[4], q3[4], q4[4], z[4];
        rates(c, p->knee, film, x, u, q1);
        for (int j = 0; j < 4; j++)
            z[j] = x[j] + 0.5 * dt * q1[j];
        rates(c, p->knee, film, z, u, q2);
        if (!rk4) {
            for (int j = 0; j < 4; j++)
                x[j] += dt * q2[j];
            continue;
        }
        for (int j = 0; j < 4; j++)
            z[j] = x[j] + 0.5 * dt * q2[j];
        rates(c, p->knee, film, z, u, q3);
        for (int j = 0; j < 4; j++)
            z[j] = x[j] + dt * q3[j];
        rates(c, p->knee, film, z, u, q4);
        for (int j = 0; j < 4; j++)
            x[j] += dt / 6.0 * (q1[j] + 2.0 * (q2[j] + q3[j]) + q4[j]);
    }
    result[0] = sum;
    for (int j = 0; j < 4; j++)
        result[1 + j] = top[j];
    return sqrt(sum / n);
}
