/* A motor on a test unit: it turns, gets warm, and is cooled. For co-simulation by FMI 2.0. */
#include <stdlib.h>

#include "fmi2FunctionTypes.h"

enum { AMBIENT, SPEED, TEMPERATURE, REALS }; /* the value references of modelDescription.xml */
enum { DRIVE, COOLING, BOOLEANS };

typedef struct {
    double real[REALS];
    int boolean[BOOLEANS];
} Motor;

static void advance(Motor *motor, double dt_s) {
    double *real = motor->real;
    double turning = real[SPEED] / 3000.0, loss = motor->boolean[COOLING] ? 0.35 : 0.05;
    real[SPEED] += dt_s * ((motor->boolean[DRIVE] ? 3000.0 : 0.0) - real[SPEED]) / 0.4;
    real[TEMPERATURE] += dt_s * (12.0 * turning - loss * (real[TEMPERATURE] - real[AMBIENT]));
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real now, fmi2Real step, fmi2Boolean no_set) {
    int parts = 1 + (int)(step / 0.005);
    for (int part = 0; part < parts; part++) advance(c, step / parts);
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    Motor *motor = calloc(1, sizeof *motor);
    if (motor) motor->real[AMBIENT] = motor->real[TEMPERATURE] = 20.0;
    return motor;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference place[], size_t n, fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) value[i] = ((Motor *)c)->real[place[i]];
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference place[], size_t n, const fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) ((Motor *)c)->real[place[i]] = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference place[], size_t n, fmi2Boolean value[]) {
    for (size_t i = 0; i < n; i++) value[i] = ((Motor *)c)->boolean[place[i]];
    return fmi2OK;
}
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference place[], size_t n, const fmi2Boolean value[]) {
    for (size_t i = 0; i < n; i++) ((Motor *)c)->boolean[place[i]] = value[i];
    return fmi2OK;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return "2.0"; }

/* Nothing to do. */
#define ACCEPT(name) fmi2Status name(void) { return fmi2OK; }
ACCEPT(fmi2SetupExperiment)
ACCEPT(fmi2EnterInitializationMode)
ACCEPT(fmi2ExitInitializationMode)
ACCEPT(fmi2Terminate)
ACCEPT(fmi2SetDebugLogging)

/* An importer does not call these, because modelDescription.xml does not offer them. But FMI demands all functions. */
#define REFUSE(name) fmi2Status name(void) { return fmi2Error; }
REFUSE(fmi2Reset)
REFUSE(fmi2GetInteger)
REFUSE(fmi2SetInteger)
REFUSE(fmi2GetString)
REFUSE(fmi2SetString)
REFUSE(fmi2GetFMUstate)
REFUSE(fmi2SetFMUstate)
REFUSE(fmi2FreeFMUstate)
REFUSE(fmi2SerializedFMUstateSize)
REFUSE(fmi2SerializeFMUstate)
REFUSE(fmi2DeSerializeFMUstate)
REFUSE(fmi2GetDirectionalDerivative)
REFUSE(fmi2SetRealInputDerivatives)
REFUSE(fmi2GetRealOutputDerivatives)
REFUSE(fmi2CancelStep)
REFUSE(fmi2GetStatus)
REFUSE(fmi2GetRealStatus)
REFUSE(fmi2GetIntegerStatus)
REFUSE(fmi2GetBooleanStatus)
REFUSE(fmi2GetStringStatus)
