const char *fmi2GetTypesPlatform(void) { return "default"; }

const char *fmi2GetVersion(void) { return "2.0"; }

void *fmi2Instantiate(void) { return make(); }

void fmi2FreeInstance(Model *m) { free(m); }

int fmi2Reset(Model *m) { reset(m); return OK; }

int fmi2SetupExperiment(Model *m, int b, double e, double t, int s, double end)
{
    (void)b; (void)e; (void)s; (void)end;
    m->t = t;
    return OK;
}

int fmi2ExitInitializationMode(Model *m) { begin(m); return OK; }

int fmi2GetReal(Model *m, const uint32_t *refs, size_t n, double *values)
{
    return get(m, refs, n, values);
}

int fmi2SetReal(Model *m, const uint32_t *refs, size_t n, const double *values)
{
    return set(m, refs, n, values);
}

int fmi2GetBoolean(Model *m, const uint32_t *refs, size_t n, int *values)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS) return ERROR;
        values[k] = m->manual;
    }
    return OK;
}

int fmi2SetBoolean(Model *m, const uint32_t *refs, size_t n, const int *values)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS) return ERROR;
        m->manual = values[k] != 0;
    }
    return OK;
}

int fmi2DoStep(Model *m, double t, double h, int no) { (void)no; return advance(m, t, h); }
