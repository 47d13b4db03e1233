#include "${name}.h"
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { OK = 0, ERROR = 3, PARAMETERS = ${parameters}, NUMBERS = ${numbers} };

typedef struct {
    ${name}_state state;
    ${name}_parameters p;
    double v[NUMBERS - PARAMETERS]; /* inputs, then outputs */
    double t;
    bool manual, begun;
} Model;

static void reset(Model *m)
{
    static const double start[NUMBERS - PARAMETERS] = {${start}};
    m->p = ${name}_defaults;
    for (int i = 0; i < NUMBERS - PARAMETERS; ++i) m->v[i] = start[i];
    m->t = 0.0;
    m->manual = m->begun = false;
}

static Model *make(void)
{
    Model *m = calloc(1, sizeof *m);
    if (m) reset(m);
    return m;
}

static void begin(Model *m)
{
    ${init};
    m->begun = true;
}

static int advance(Model *m, double t, double h)
{
    const int periods = (int)(h / ${name}_dt + 0.5);
    const double rest = h - periods * ${name}_dt;
    if (periods < 1 || rest > 1e-6 * ${name}_dt || rest < -1e-6 * ${name}_dt) return ERROR;
    for (int i = 0; i < periods; ++i) ${step};
    m->t = t + h;
    return OK;
}

static double *at(Model *m, uint32_t i)
{
    if (i < PARAMETERS) return (double *)&m->p + i;
    return i < NUMBERS ? m->v + (i - PARAMETERS) : i == NUMBERS + 1 ? &m->t : NULL;
}

static int get(Model *m, const uint32_t *refs, size_t n, double *values)
{
    if (!m->begun) begin(m);
    for (size_t k = 0; k < n; ++k) {
        if (!at(m, refs[k])) return ERROR;
        values[k] = *at(m, refs[k]);
    }
    return OK;
}

static int set(Model *m, const uint32_t *refs, size_t n, const double *values)
{
    for (size_t k = 0; k < n; ++k) {
        if (!at(m, refs[k])) return ERROR;
        *at(m, refs[k]) = values[k];
    }
    return OK;
}

/* functions that this FMU has not: the arguments are not read */
#define NONE(name) EXPORT int name(void); int name(void) { return ERROR; }
#define FINE(name) EXPORT int name(void); int name(void) { return OK; }
