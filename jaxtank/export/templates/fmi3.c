EXPORT const char *fmi3GetVersion(void);
const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateCoSimulation(void);
void *fmi3InstantiateCoSimulation(void) { return make(); }

EXPORT void fmi3FreeInstance(Model *m);
void fmi3FreeInstance(Model *m) { free(m); }

EXPORT int fmi3Reset(Model *m);
int fmi3Reset(Model *m) { reset(m); return OK; }

EXPORT int fmi3EnterInitializationMode(Model *m, bool b, double e, double t, bool s, double end);
int fmi3EnterInitializationMode(Model *m, bool b, double e, double t, bool s, double end)
{
    (void)b; (void)e; (void)s; (void)end;
    m->t = t;
    return OK;
}

EXPORT int fmi3ExitInitializationMode(Model *m);
int fmi3ExitInitializationMode(Model *m) { begin(m); return OK; }

EXPORT int fmi3GetFloat64(Model *m, const uint32_t *refs, size_t n, double *values, size_t many);
int fmi3GetFloat64(Model *m, const uint32_t *refs, size_t n, double *values, size_t many)
{
    return many == n ? get(m, refs, n, values) : ERROR;
}

EXPORT int fmi3SetFloat64(Model *m, const uint32_t *refs, size_t n, const double *v, size_t many);
int fmi3SetFloat64(Model *m, const uint32_t *refs, size_t n, const double *v, size_t many)
{
    return many == n ? set(m, refs, n, v) : ERROR;
}

EXPORT int fmi3GetBoolean(Model *m, const uint32_t *refs, size_t n, bool *values, size_t many);
int fmi3GetBoolean(Model *m, const uint32_t *refs, size_t n, bool *values, size_t many)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS || many != n) return ERROR;
        values[k] = m->manual;
    }
    return OK;
}

EXPORT int fmi3SetBoolean(Model *m, const uint32_t *refs, size_t n, const bool *v, size_t many);
int fmi3SetBoolean(Model *m, const uint32_t *refs, size_t n, const bool *v, size_t many)
{
    for (size_t k = 0; k < n; ++k) {
        if (refs[k] != NUMBERS || many != n) return ERROR;
        m->manual = v[k];
    }
    return OK;
}

EXPORT int fmi3DoStep(Model *m, double t, double h, bool no, bool *event, bool *stop, bool *early,
                      double *last);
int fmi3DoStep(Model *m, double t, double h, bool no, bool *event, bool *stop, bool *early,
               double *last)
{
    (void)no;
    const int status = advance(m, t, h);
    *event = *stop = *early = false;
    *last = m->t;
    return status;
}

NONE(fmi3InstantiateModelExchange)
NONE(fmi3InstantiateScheduledExecution)
NONE(fmi3GetNumberOfVariableDependencies)
NONE(fmi3GetVariableDependencies)
NONE(fmi3GetFMUState)
NONE(fmi3SetFMUState)
NONE(fmi3FreeFMUState)
NONE(fmi3SerializedFMUStateSize)
NONE(fmi3SerializeFMUState)
NONE(fmi3DeserializeFMUState)
NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetAdjointDerivative)
NONE(fmi3EnterConfigurationMode)
NONE(fmi3ExitConfigurationMode)
NONE(fmi3GetIntervalDecimal)
NONE(fmi3GetIntervalFraction)
NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction)
NONE(fmi3SetIntervalDecimal)
NONE(fmi3SetIntervalFraction)
NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction)
NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3UpdateDiscreteStates)
NONE(fmi3EnterContinuousTimeMode)
NONE(fmi3CompletedIntegratorStep)
NONE(fmi3SetTime)
NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives)
NONE(fmi3GetEventIndicators)
NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates)
NONE(fmi3GetNumberOfEventIndicators)
NONE(fmi3GetNumberOfContinuousStates)
NONE(fmi3GetOutputDerivatives)
NONE(fmi3ActivateModelPartition)
NONE(fmi3EnterEventMode)
NONE(fmi3GetFloat32)
NONE(fmi3SetFloat32)
NONE(fmi3GetInt8)
NONE(fmi3SetInt8)
NONE(fmi3GetUInt8)
NONE(fmi3SetUInt8)
NONE(fmi3GetInt16)
NONE(fmi3SetInt16)
NONE(fmi3GetUInt16)
NONE(fmi3SetUInt16)
NONE(fmi3GetInt32)
NONE(fmi3SetInt32)
NONE(fmi3GetUInt32)
NONE(fmi3SetUInt32)
NONE(fmi3GetInt64)
NONE(fmi3SetInt64)
NONE(fmi3GetUInt64)
NONE(fmi3SetUInt64)
NONE(fmi3GetString)
NONE(fmi3SetString)
NONE(fmi3GetBinary)
NONE(fmi3SetBinary)
NONE(fmi3GetClock)
NONE(fmi3SetClock)
FINE(fmi3SetDebugLogging)
FINE(fmi3EnterStepMode)
FINE(fmi3Terminate)
