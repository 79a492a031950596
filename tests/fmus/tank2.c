/* A tank with a pump, as an FMU for co-simulation by FMI 2.0. The input "trouble" makes it fail in many ways. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "fmi2Functions.h"

enum { INFLOW, LEVEL, AREA, PULSES, TROUBLE, RUNS, OPEN, LABEL, CAPTION, PHASE, CALLS };
enum { NOTHING, CRASH, HANG, ERROR, END, DISCARD_TWICE, DISCARD_LONG, HALF };

typedef struct {
    const fmi2CallbackFunctions *callbacks;
    double inflow, level, area, phase, last;
    int pulses, trouble, runs, open, calls, discards, ended;
    double work_s; /* CPU time that each step takes, for benchmarks */
    char label[300], caption[300];
} Tank;

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible, fmi2Boolean logging) {
    Tank *tank = calloc(1, sizeof *tank);
    tank->callbacks = callbacks;
    tank->inflow = 0.5;
    tank->area = 2.0;
    tank->level = 1.0;
    strcpy(tank->label, "small");
    const char *work_us = getenv("TANK_WORK_US");
    if (work_us) tank->work_s = atof(work_us) / 1e6;
    if (strcmp(guid, "{tank-2}")) return NULL;
    return tank;
}

void fmi2FreeInstance(fmi2Component c) {
    const char *file = getenv("TANK_ENDS");
    if (file) {
        FILE *out = fopen(file, "a");
        fputs("free\n", out);
        fclose(out);
    }
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real t, fmi2Real start, fmi2Boolean e, fmi2Real stop) {
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    Tank *tank = c;
    snprintf(tank->caption, sizeof tank->caption, "%s tank", tank->label);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) {
    const char *file = getenv("TANK_ENDS");
    if (file) {
        FILE *out = fopen(file, "a");
        fputs("terminate\n", out);
        fclose(out);
    }
    return fmi2OK;
}

static double *reals(Tank *tank, unsigned reference) {
    switch (reference) {
    case INFLOW: return &tank->inflow;
    case LEVEL: return &tank->level;
    case AREA: return &tank->area;
    case PHASE: return &tank->phase;
    }
    return NULL;
}

static int *integers(Tank *tank, unsigned reference) {
    switch (reference) {
    case PULSES: return &tank->pulses;
    case TROUBLE: return &tank->trouble;
    case RUNS: return &tank->runs;
    case OPEN: return &tank->open;
    case CALLS: return &tank->calls;
    }
    return NULL;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) value[i] = *reals(c, vr[i]);
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    for (size_t i = 0; i < n; i++) *reals(c, vr[i]) = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[]) {
    for (size_t i = 0; i < n; i++) value[i] = *integers(c, vr[i]);
    return fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[]) {
    for (size_t i = 0; i < n; i++) *integers(c, vr[i]) = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[]) {
    for (size_t i = 0; i < n; i++) value[i] = *integers(c, vr[i]);
    return fmi2OK;
}
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[]) {
    for (size_t i = 0; i < n; i++) *integers(c, vr[i]) = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]) {
    Tank *tank = c;
    for (size_t i = 0; i < n; i++) value[i] = vr[i] == LABEL ? tank->label : tank->caption;
    return fmi2OK;
}
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]) {
    Tank *tank = c;
    for (size_t i = 0; i < n; i++) snprintf(tank->label, sizeof tank->label, "%s", value[i]);
    return fmi2OK;
}

static double cpu_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return now.tv_sec + now.tv_nsec / 1e9;
}

static void flow(Tank *tank, double now, double step) {
    double out = tank->open ? 0.3 * sqrt(fmax(tank->level, 0.0)) : 0.0;
    tank->level += step * (tank->inflow - out + 0.01 * sin(now)) / tank->area;
    tank->phase = cos(now + step);
    tank->last = now + step;
    tank->runs++;
    for (double until = cpu_s() + tank->work_s; tank->work_s && cpu_s() < until;) {}
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real now, fmi2Real step, fmi2Boolean no_set) {
    Tank *tank = c;
    tank->calls++;
    switch (tank->trouble) {
    case CRASH:
        *(volatile int *)8 = 1;
        break;
    case HANG:
        for (;;) pause();
    case ERROR:
        tank->callbacks->logger(tank->callbacks->componentEnvironment, "tank", fmi2Error, "error",
                                "the solver failed at %g%%", 99.5);
        return fmi2Error;
    case END:
        tank->ended = 1;
        tank->last = now;
        return fmi2Discard;
    case DISCARD_TWICE: /* each step is discarded twice, and then done */
        tank->last = now;
        if (tank->discards++ % 3 < 2) return fmi2Discard;
        break;
    case DISCARD_LONG:
        tank->last = now;
        if (step > 0.005) return fmi2Discard;
        break;
    case HALF:
        if (step > 0.005) {
            flow(tank, now, step / 2);
            return fmi2Discard;
        }
        break;
    }
    flow(tank, now, step);
    return fmi2OK;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    *value = ((Tank *)c)->last;
    return fmi2OK;
}
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    *value = ((Tank *)c)->ended;
    return fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    *state = malloc(sizeof(Tank));
    memcpy(*state, c, sizeof(Tank));
    return fmi2OK;
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    Tank *tank = c;
    const fmi2CallbackFunctions *callbacks = tank->callbacks;
    memcpy(tank, state, sizeof *tank);
    tank->callbacks = callbacks;
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    free(*state);
    *state = NULL;
    return fmi2OK;
}
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    *size = sizeof(Tank);
    return fmi2OK;
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    memcpy(bytes, state, size);
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    if (size != sizeof(Tank)) return fmi2Error;
    *state = malloc(size);
    memcpy(*state, bytes, size);
    return fmi2OK;
}
