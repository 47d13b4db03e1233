EXPORT const char *fmi2GetTypesPlatform(void);
const char *fmi2GetTypesPlatform(void) { return "default"; }

EXPORT const char *fmi2GetVersion(void);
const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT void *fmi2Instantiate(void);
void *fmi2Instantiate(void) { return make(); }

EXPORT void fmi2FreeInstance(Model *m);
void fmi2FreeInstance(Model *m) { free(m); }

EXPORT int fmi2Reset(Model *m);
int fmi2Reset(Model *m) { reset(m); return OK; }

EXPORT int fmi2SetupExperiment(Model *m, int b, double e, double t, int s, double end);
int fmi2SetupExperiment(Model *m, int b, double e, double t, int s, double end)
{
    (void)b; (void)e; (void)s; (void)end;
    m->t = t;
    return OK;
}

EXPORT int fmi2ExitInitializationMode(Model *m);
int fmi2ExitInitializationMode(Model *m) { begin(m); return OK; }

EXPORT int fmi2GetReal(Model *m, const uint32_t *refs, size_t n, double *values);
int fmi2GetReal(Model *m, const uint32_t *refs, size_t n, double *values)
{
    return get(m, refs, n, values);
}

EXPORT int fmi2SetReal(Model *m, const uint32_t *refs, size_t n, const double *values);
int fmi2SetReal(Model *m, const uint32_t *refs, size_t n, const double *values)
{
    return set(m, refs, n, values);
}

EXPORT int fmi2GetBoolean(Model *m, const uint32_t *refs, size_t n, int *values);
int fmi2GetBoolean(Model *m, const uint32_t *refs, size_t n, int *values)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS) return ERROR;
        values[k] = m->manual;
    }
    return OK;
}

EXPORT int fmi2SetBoolean(Model *m, const uint32_t *refs, size_t n, const int *values);
int fmi2SetBoolean(Model *m, const uint32_t *refs, size_t n, const int *values)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS) return ERROR;
        m->manual = values[k] != 0;
    }
    return OK;
}

EXPORT int fmi2DoStep(Model *m, double t, double h, int no);
int fmi2DoStep(Model *m, double t, double h, int no) { (void)no; return advance(m, t, h); }

NONE(fmi2GetInteger)
NONE(fmi2SetInteger)
NONE(fmi2GetString)
NONE(fmi2SetString)
NONE(fmi2GetFMUstate)
NONE(fmi2SetFMUstate)
NONE(fmi2FreeFMUstate)
NONE(fmi2SerializedFMUstateSize)
NONE(fmi2SerializeFMUstate)
NONE(fmi2DeSerializeFMUstate)
NONE(fmi2GetDirectionalDerivative)
NONE(fmi2SetRealInputDerivatives)
NONE(fmi2GetRealOutputDerivatives)
NONE(fmi2CancelStep)
NONE(fmi2GetStatus)
NONE(fmi2GetRealStatus)
NONE(fmi2GetIntegerStatus)
NONE(fmi2GetBooleanStatus)
NONE(fmi2GetStringStatus)
FINE(fmi2SetDebugLogging)
FINE(fmi2EnterInitializationMode)
FINE(fmi2Terminate)
