#include "${name}.h"
static ${name}_state state;
static void copy(${name}_real *a, const double *b, int n) {
    for (int i = 0; i < n; ++i) a[i] = (${name}_real)b[i];
}
#define OUT __attribute__((visibility("default")))
OUT void sizes(int *n) { n[0] = ${upper}_TANKS; n[1] = ${upper}_OUTPUTS; n[2] = ${upper}_PUMPS; }
OUT const char *unit(int i) { return ${units}; }
OUT double period(void) { return ${name}_dt; }
OUT void begin(const double *y) {
    ${name}_real a[${upper}_TANKS];
    copy(a, y, ${upper}_TANKS);
    ${name}_init(&state, 0, a, 0);
}
OUT void step(double t, const double *y, const double *r, const double *dr, const double *ddr,
              double *u) {
    ${name}_real a[${upper}_TANKS], b[${upper}_OUTPUTS], c[${upper}_OUTPUTS], d[${upper}_OUTPUTS],
        e[${upper}_PUMPS];
    copy(a, y, ${upper}_TANKS);
    copy(b, r, ${upper}_OUTPUTS);
    copy(c, dr, ${upper}_OUTPUTS);
    copy(d, ddr, ${upper}_OUTPUTS);
    ${name}_step(&state, 0, (${name}_real)t, a, b, c, d, 0, e);
    for (int i = 0; i < ${upper}_PUMPS; ++i) u[i] = e[i];
}
