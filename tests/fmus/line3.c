/* A line of stations, as an FMU for co-simulation by FMI 3.0: structural parameters, event mode, and refused values. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"

enum { SIZE, FACTORS, SUMS, MODE, MODE_OUT, LEVEL, NAME, NAME_OUT, CALLS, SPEED };
enum { COLUMNS = 3, MAX_SIZE = 10, EVENT_MODE = 7, LOCKED = 150 };

typedef struct {
    size_t size;
    double factors[MAX_SIZE * COLUMNS], sums[MAX_SIZE], speed;
    fmi3Int64 mode, mode_out;
    unsigned char level;
    bool has_events, in_event_mode;
    char name[4000], name_out[4000], calls[4000];
} Line;

static void note(Line *line, const char *call) {
    if (strlen(line->calls) < 3000) strcat(strcat(line->calls, line->calls[0] ? " " : ""), call);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean event_mode, fmi3Boolean early_return, const fmi3ValueReference required[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    if (event_mode && getenv("LINE_WITHOUT_EVENTS")) return NULL;
    Line *line = calloc(1, sizeof *line);
    line->size = 2;
    line->has_events = event_mode;
    for (int i = 0; i < MAX_SIZE * COLUMNS; i++) line->factors[i] = i + 1;
    strcpy(line->name_out, "-");
    return line;
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { return note(c, "configure"), fmi3OK; }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 t, fmi3Float64 start, fmi3Boolean e,
                                       fmi3Float64 stop) {
    return note(c, "initialise"), fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    Line *line = c;
    line->in_event_mode = line->has_events;
    return fmi3OK;
}
fmi3Status fmi3EnterEventMode(fmi3Instance c) {
    Line *line = c;
    note(line, "event");
    if (line->in_event_mode) return fmi3Error;
    line->in_event_mode = true;
    return fmi3OK;
}
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *needed, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *next, fmi3Float64 *next_time) {
    Line *line = c;
    *needed = line->mode_out != line->mode;
    *terminate = *nominals = *values = *next = false;
    line->mode_out = line->mode;
    return note(line, "update"), fmi3OK;
}
fmi3Status fmi3EnterStepMode(fmi3Instance c) {
    Line *line = c;
    line->in_event_mode = false;
    return note(line, "steps"), fmi3OK;
}
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }

fmi3Status fmi3SetUInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 value[], size_t k) {
    Line *line = c;
    if (value[0] < 1 || value[0] > MAX_SIZE) return fmi3Error;
    line->size = value[0];
    return fmi3OK;
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[], size_t k) {
    Line *line = c;
    if (vr[0] == SPEED) line->speed = value[0];
    else memcpy(line->factors, value, k * sizeof *value);
    return fmi3OK;
}
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t k) {
    Line *line = c;
    for (size_t i = 0; i < n; i++) {
        size_t size = vr[i] == SUMS ? line->size : 1;
        memcpy(value, vr[i] == SUMS ? line->sums : &line->speed, size * sizeof *value);
        value += size;
    }
    return fmi3OK;
}
fmi3Status fmi3SetInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Int64 value[], size_t k) {
    Line *line = c;
    if (value[0] != 1 && value[0] != 2 && value[0] != EVENT_MODE) return fmi3Error;
    if (line->has_events && strstr(line->calls, "steps") && !line->in_event_mode) return fmi3Error;
    line->mode = value[0];
    return fmi3OK;
}
fmi3Status fmi3GetInt64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Int64 value[], size_t k) {
    Line *line = c;
    for (size_t i = 0; i < n; i++) value[i] = vr[i] == MODE ? line->mode : line->mode_out;
    return fmi3OK;
}
fmi3Status fmi3SetUInt8(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3UInt8 value[], size_t k) {
    Line *line = c;
    if (value[0] == LOCKED) return fmi3Discard;
    line->level = value[0];
    return fmi3OK;
}
fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3String value[], size_t k) {
    Line *line = c;
    snprintf(line->name, sizeof line->name, "%s", value[0]);
    return fmi3OK;
}
fmi3Status fmi3GetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3String value[], size_t k) {
    Line *line = c;
    for (size_t i = 0; i < n; i++) value[i] = vr[i] == NAME_OUT ? line->name_out : line->calls;
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 now, fmi3Float64 step, fmi3Boolean no_set, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
    Line *line = c;
    *terminate = *early = false;
    *event = line->mode == EVENT_MODE;
    *reached = now + step;
    for (size_t i = 0; i < line->size; i++) {
        line->sums[i] = line->level + line->speed;
        for (int j = 0; j < COLUMNS; j++) line->sums[i] += line->factors[i * COLUMNS + j];
    }
    strcpy(line->name_out, strcmp(line->name, "Latin") ? line->name : "caf\xe9");
    if (!line->has_events) line->mode_out = line->mode;
    return fmi3OK;
}
