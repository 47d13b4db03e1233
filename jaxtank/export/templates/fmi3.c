const char *fmi3GetVersion(void) { return "3.0"; }

void *fmi3InstantiateCoSimulation(void) { return make(); }

void fmi3FreeInstance(Model *m) { free(m); }

int fmi3Reset(Model *m) { reset(m); return OK; }

int fmi3EnterInitializationMode(Model *m, bool b, double e, double t, bool s, double end)
{
    (void)b; (void)e; (void)s; (void)end;
    m->t = t;
    return OK;
}

int fmi3ExitInitializationMode(Model *m) { begin(m); return OK; }

int fmi3GetFloat64(Model *m, const uint32_t *refs, size_t n, double *values, size_t many)
{
    return many == n ? get(m, refs, n, values) : ERROR;
}

int fmi3SetFloat64(Model *m, const uint32_t *refs, size_t n, const double *v, size_t many)
{
    return many == n ? set(m, refs, n, v) : ERROR;
}

int fmi3GetBoolean(Model *m, const uint32_t *refs, size_t n, bool *values, size_t many)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS || many != n) return ERROR;
        values[k] = m->manual;
    }
    return OK;
}

int fmi3SetBoolean(Model *m, const uint32_t *refs, size_t n, const bool *v, size_t many)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS || many != n) return ERROR;
        m->manual = v[k];
    }
    return OK;
}

int fmi3DoStep(Model *m, double t, double h, bool no, bool *event, bool *stop, bool *early,
               double *last)
{
    (void)no;
    const int status = advance(m, t, h);
    *event = *stop = *early = false;
    *last = m->t;
    return status;
}
