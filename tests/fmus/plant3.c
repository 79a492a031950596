/* Two axes, as an FMU for co-simulation by FMI 3.0: arrays, all types, early returns and discards. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi3Functions.h"

enum { COMMAND, POSITION, GAIN, SMALL, SMALL_OUT, TROUBLE, BITS, BITS_OUT, TEXT, TEXT_OUT, BIG, BIG_OUT, BYTE, MODE };
enum { NOTHING, EARLY, DISCARD_LONG, END, ERROR };

typedef struct {
    double command[6], position[6], gain[2];
    float small, small_out;
    int trouble, early;
    bool bits[3], bits_out[3];
    unsigned long long big, big_out;
    unsigned char byte;
    long long mode;
    char text[300], text_out[300];
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Plant;

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean event_mode, fmi3Boolean early_return, const fmi3ValueReference required[], size_t n,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    if (strcmp(token, "{plant-3}")) return NULL;
    Plant *plant = calloc(1, sizeof *plant);
    plant->log = log;
    plant->environment = environment;
    plant->early = early_return;
    plant->gain[0] = plant->gain[1] = 1.5;
    plant->mode = 2;
    return plant;
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 t, fmi3Float64 start, fmi3Boolean e,
                                       fmi3Float64 stop) {
    return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }

#define ACCESS(Type, type, PLACE)                                                                                      \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, type value[], size_t count) {    \
        Plant *plant = c;                                                                                              \
        for (size_t i = 0; i < n; i++) {                                                                               \
            size_t size = 0;                                                                                           \
            type *from = PLACE(plant, vr[i], &size);                                                                   \
            memcpy(value, from, size * sizeof *from);                                                                  \
            value += size;                                                                                             \
        }                                                                                                              \
        return fmi3OK;                                                                                                 \
    }                                                                                                                  \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const type value[],              \
                             size_t count) {                                                                           \
        Plant *plant = c;                                                                                              \
        for (size_t i = 0; i < n; i++) {                                                                               \
            size_t size = 0;                                                                                           \
            type *to = PLACE(plant, vr[i], &size);                                                                     \
            memcpy(to, value, size * sizeof *to);                                                                      \
            value += size;                                                                                             \
        }                                                                                                              \
        return fmi3OK;                                                                                                 \
    }

static double *doubles(Plant *plant, unsigned reference, size_t *size) {
    *size = reference == GAIN ? 2 : 6;
    return reference == COMMAND ? plant->command : reference == POSITION ? plant->position : plant->gain;
}
static float *floats(Plant *plant, unsigned reference, size_t *size) {
    *size = 1;
    return reference == SMALL ? &plant->small : &plant->small_out;
}
static int *integers(Plant *plant, unsigned reference, size_t *size) {
    *size = 1;
    return &plant->trouble;
}
static bool *booleans(Plant *plant, unsigned reference, size_t *size) {
    *size = 3;
    return reference == BITS ? plant->bits : plant->bits_out;
}
static fmi3UInt64 *bigs(Plant *plant, unsigned reference, size_t *size) {
    *size = 1;
    return (fmi3UInt64 *)(reference == BIG ? &plant->big : &plant->big_out);
}
static fmi3Int64 *modes(Plant *plant, unsigned reference, size_t *size) {
    *size = 1;
    return (fmi3Int64 *)&plant->mode;
}
static unsigned char *bytes(Plant *plant, unsigned reference, size_t *size) {
    *size = 1;
    return &plant->byte;
}
ACCESS(Float64, fmi3Float64, doubles)
ACCESS(Float32, fmi3Float32, floats)
ACCESS(Int32, fmi3Int32, integers)
ACCESS(Boolean, fmi3Boolean, booleans)
ACCESS(UInt64, fmi3UInt64, bigs)
ACCESS(Int64, fmi3Int64, modes)
ACCESS(UInt8, fmi3UInt8, bytes)

fmi3Status fmi3GetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3String value[], size_t count) {
    Plant *plant = c;
    for (size_t i = 0; i < n; i++) value[i] = vr[i] == TEXT ? plant->text : plant->text_out;
    return fmi3OK;
}
fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3String value[],
                         size_t count) {
    Plant *plant = c;
    for (size_t i = 0; i < n; i++) snprintf(plant->text, sizeof plant->text, "%s", value[i]);
    return fmi3OK;
}

static void move(Plant *plant, double now, double step) {
    for (int i = 0; i < 6; i++)
        plant->position[i] += step * plant->gain[i % 2] * (plant->command[i] - plant->position[i]) + 1e-3 * sin(now);
    plant->small_out = plant->small / 3.0f;
    for (int i = 0; i < 3; i++) plant->bits_out[i] = !plant->bits[i];
    plant->big_out = ~plant->big;
    plant->byte++;
    snprintf(plant->text_out, sizeof plant->text_out, "<%s>", plant->text);
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 now, fmi3Float64 step, fmi3Boolean no_set, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
    Plant *plant = c;
    *event = *terminate = *early = false;
    *reached = now + step;
    if (plant->trouble == END) {
        *terminate = true;
        *reached = now;
        return fmi3OK;
    }
    if (plant->trouble == ERROR) {
        plant->log(plant->environment, fmi3Error, "error", "axis 2 is blocked");
        return fmi3Error;
    }
    if (plant->trouble == DISCARD_LONG && step > 0.005) return fmi3Discard;
    if (plant->trouble == EARLY && plant->early && step > 0.006) {
        *early = true;
        step = step / 3;
        *reached = now + step;
    }
    move(plant, now, step);
    return fmi3OK;
}
