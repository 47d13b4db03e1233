/* A chain of n tanks joined by pipes under one PID, as a C programmer would write it: RK4, one pass over the pipes and one over
   the tanks for each stage, both of which vectorise, running sum of squared errors and maxima. The same arithmetic as jaxtank's scan, in float64. */

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    long n, output;
    double area, drain, last_drain, pipe, pump_gain, gravity, knee, dt, low, high, Kc, Ti, Td, Tt, bias;
} chain;

/* branchless, so that a compiler vectorises it */
static inline double root(double h, double knee, double film)
{
    double x = h * (1.0 / knee), shallow = film * x * (1.5 - 0.5 * (x > 0.0 ? x : 0.0)), deep = sqrt(h >= knee ? h : knee);
    return h >= knee ? deep : shallow;
}

/* flow: (n + 1,) through the pipe in front of each tank */
static void rates(const chain *c, const double *restrict x, double inflow, double *restrict flow, double *restrict dx)
{
    long n = c->n;
    double w = sqrt(2.0 * c->gravity), out = c->drain * w / c->area, through = c->pipe * w / c->area, k = c->knee * c->knee;
    double knee = c->knee, film = sqrt(knee);
    flow[0] = inflow / c->area;
    flow[n] = (c->last_drain - c->drain) * w / c->area * root(x[n - 1], knee, film);
    for (long i = 1; i < n; i++) {
        double d = x[i - 1] - x[i];
        flow[i] = through * (d / sqrt(sqrt(d * d + k)));
    }
    for (long i = 0; i < n; i++)
        dx[i] = flow[i] - flow[i + 1] - out * root(x[i], knee, film);
}

/* r: setpoints of the output, one a sample; x: levels, which are changed; top: highest levels. Returns the rms error [cm]. */
double run(const chain *c, long samples, const double *r, double *restrict x, double *restrict top)
{
    long n = c->n;
    double *k1 = malloc((6 * n + 1) * sizeof(double)), *k2 = k1 + n, *k3 = k2 + n, *k4 = k3 + n, *z = k4 + n, *f = z + n, dt = c->dt;
    double sum = 0.0, integral = 0.0, slow = x[c->output], follow = 1.0 - exp(-dt * 8.0 / c->Td);
    for (long i = 0; i < n; i++)
        top[i] = -INFINITY;
    for (long s = 0; s < samples; s++) {
        double y = x[c->output], e = r[s] - y, v = c->bias + c->Kc * e + integral - 8.0 * c->Kc * (y - slow);
        slow += follow * (y - slow);
        double u = v < c->low ? c->low : (v > c->high ? c->high : v), inflow = c->pump_gain * u;
        integral += dt * c->Kc / c->Ti * (e + c->Ti / (c->Tt * c->Kc) * (u - v));
        sum += e * e;
        rates(c, x, inflow, f, k1);
        for (long i = 0; i < n; i++) {
            top[i] = x[i] > top[i] ? x[i] : top[i];
            z[i] = x[i] + 0.5 * dt * k1[i];
        }
        rates(c, z, inflow, f, k2);
        for (long i = 0; i < n; i++)
            z[i] = x[i] + 0.5 * dt * k2[i];
        rates(c, z, inflow, f, k3);
        for (long i = 0; i < n; i++)
            z[i] = x[i] + dt * k3[i];
        rates(c, z, inflow, f, k4);
        for (long i = 0; i < n; i++)
            x[i] += dt / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
    }
    free(k1);
    return sqrt(sum / samples);
}
