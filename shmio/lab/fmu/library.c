/* The library of an exported instance: an FMU for co-simulation by FMI 2.0.
 *
 * It starts a Python process (shmio.lab.fmu.process) for each instance of the FMU, and exchanges
 * messages with it over a socket: u32 kind, u32 size, then size bytes. The values are one array for
 * each type; value references are indices. See exchange.py for the messages.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define EXPORT __attribute__((visibility("default")))

/* ---- the types of FMI 2.0 (fmi-standard.org) ---- */
typedef void *Component;
typedef void *Environment;
typedef unsigned int Reference;
typedef int Boolean;
typedef const char *String;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL, PENDING } Status;
typedef struct {
    void (*logger)(Environment, String, Status, String, String, ...);
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(Environment, Status);
    Environment environment;
} Callbacks;

enum { HELLO = 1, INITIALISE = 2, STEP = 3, END = 4 };
enum { MAX_MESSAGE = 1 << 28, CHILD_FD = 3, END_MS = 10000 };

typedef struct {
    Callbacks callbacks;
    char *name;
    int socket;
    pid_t child;
    Status status; /* the worst so far */
    uint32_t counts[4]; /* reals, integers, booleans, strings */
    double *reals;
    int32_t *integers, *booleans;
    char **strings;
    char *message; /* the last message received */
    size_t message_size;
} Cell;

static Status fail(Cell *cell, Status status, const char *format, ...)
{
    char text[2048];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    if (status > cell->status) cell->status = status;
    if (cell->callbacks.logger)
        cell->callbacks.logger(cell->callbacks.environment, cell->name, status, "logStatusError", "%s", text);
    return status;
}

/* ---- messages ---- */
static int send_all(int fd, const void *data, size_t size)
{
    const char *at = data;
    while (size) {
        ssize_t sent = send(fd, at, size, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR) continue;
        if (sent <= 0) return -1;
        at += sent;
        size -= (size_t)sent;
    }
    return 0;
}

static int receive_all(int fd, void *data, size_t size)
{
    char *at = data;
    while (size) {
        ssize_t got = recv(fd, at, size, 0);
        if (got < 0 && errno == EINTR) continue;
        if (got <= 0) return -1;
        at += got;
        size -= (size_t)got;
    }
    return 0;
}

/* Receive an answer. Its kind is 0 if the request was carried out; otherwise the message is the reason. */
static Status receive(Cell *cell, const char *what)
{
    uint32_t head[2];
    if (receive_all(cell->socket, head, sizeof head) || head[1] > MAX_MESSAGE)
        return fail(cell, FATAL, "%s: the process of the instance has ended; its error output says why", what);
    char *message = realloc(cell->message, (size_t)head[1] + 1);
    if (!message) return fail(cell, FATAL, "%s: no memory", what);
    cell->message = message;
    cell->message_size = head[1];
    if (receive_all(cell->socket, message, head[1]))
        return fail(cell, FATAL, "%s: the process of the instance has ended; its error output says why", what);
    message[head[1]] = 0;
    return head[0] ? fail(cell, ERROR, "%s: %s", what, message) : OK;
}

static size_t values_size(const Cell *cell)
{
    size_t size = cell->counts[0] * sizeof(double) + ((size_t)cell->counts[1] + cell->counts[2]) * sizeof(int32_t);
    for (uint32_t i = 0; i < cell->counts[3]; i++) size += 4 + strlen(cell->strings[i]);
    return size;
}

static char *put(char *at, const void *data, size_t size)
{
    if (size) memcpy(at, data, size);
    return at + size;
}

/* Send a request with two numbers and all values, and take the values of the answer. */
static Status exchange(Cell *cell, uint32_t kind, double first, double second, const char *what)
{
    if (cell->status >= ERROR) return fail(cell, cell->status, "%s: an earlier call has failed", what);
    size_t size = 2 * sizeof(double) + values_size(cell);
    char *request = malloc(8 + size), *at = request;
    if (!request) return fail(cell, FATAL, "%s: no memory", what);
    uint32_t head[2] = {kind, (uint32_t)size};
    double numbers[2] = {first, second};
    at = put(at, head, sizeof head);
    at = put(at, numbers, sizeof numbers);
    at = put(at, cell->reals, cell->counts[0] * sizeof(double));
    at = put(at, cell->integers, cell->counts[1] * sizeof(int32_t));
    at = put(at, cell->booleans, cell->counts[2] * sizeof(int32_t));
    for (uint32_t i = 0; i < cell->counts[3]; i++) {
        uint32_t length = (uint32_t)strlen(cell->strings[i]);
        at = put(at, &length, sizeof length);
        at = put(at, cell->strings[i], length);
    }
    int lost = send_all(cell->socket, request, 8 + size);
    free(request);
    if (lost) return fail(cell, FATAL, "%s: the process of the instance has ended; its error output says why", what);
    Status status = receive(cell, what);
    if (status != OK) return status;
    size_t fixed = cell->counts[0] * sizeof(double) + ((size_t)cell->counts[1] + cell->counts[2]) * sizeof(int32_t);
    if (cell->message_size < fixed) return fail(cell, FATAL, "%s: an answer is too short", what);
    const char *from = cell->message, *end = cell->message + cell->message_size;
    memcpy(cell->reals, from, cell->counts[0] * sizeof(double));
    from += cell->counts[0] * sizeof(double);
    memcpy(cell->integers, from, cell->counts[1] * sizeof(int32_t));
    from += cell->counts[1] * sizeof(int32_t);
    memcpy(cell->booleans, from, cell->counts[2] * sizeof(int32_t));
    from += cell->counts[2] * sizeof(int32_t);
    for (uint32_t i = 0; i < cell->counts[3]; i++) {
        uint32_t length = 0;
        if (end - from >= 4) memcpy(&length, from, 4);
        if (end - from < 4 || (size_t)(end - from) < 4 + (size_t)length)
            return fail(cell, FATAL, "%s: an answer is too short", what);
        char *text = strndup(from + 4, length);
        if (!text) return fail(cell, FATAL, "%s: no memory", what);
        free(cell->strings[i]);
        cell->strings[i] = text;
        from += 4 + length;
    }
    return OK;
}

/* ---- the process ---- */
static int hex(char c)
{
    if (c >= '0' && c <= '9') return c - '0';
    if ((c | 32) >= 'a' && (c | 32) <= 'f') return (c | 32) - 'a' + 10;
    return -1;
}

/* Convert a file URL to a path. */
static void path_of(const char *url, char *path, size_t size)
{
    if (!strncmp(url, "file:", 5)) url += 5;
    if (!strncmp(url, "//", 2)) {
        url += 2;
        if (!strncmp(url, "localhost/", 10)) url += 9;
    }
    size_t at = 0;
    while (*url && at + 1 < size) {
        if (url[0] == '%' && hex(url[1]) >= 0 && hex(url[2]) >= 0) {
            path[at++] = (char)(hex(url[1]) * 16 + hex(url[2]));
            url += 3;
        } else
            path[at++] = *url++;
    }
    path[at] = 0;
    while (at > 1 && path[at - 1] == '/') path[--at] = 0;
}

/* Choose the Python: SHMIO_PYTHON, or that of the export if it exists, or python3 of PATH. */
static void python_of(const char *resources, char *python, size_t size)
{
    const char *wanted = getenv("SHMIO_PYTHON");
    if (wanted && *wanted) {
        snprintf(python, size, "%s", wanted);
        return;
    }
    char file[PATH_MAX + 16];
    snprintf(file, sizeof file, "%s/python", resources);
    FILE *stream = fopen(file, "re");
    python[0] = 0;
    if (stream) {
        if (!fgets(python, (int)size, stream)) python[0] = 0;
        fclose(stream);
        python[strcspn(python, "\n")] = 0;
    }
    if (!python[0] || access(python, X_OK)) snprintf(python, size, "python3");
}

static Status start(Cell *cell, const char *url)
{
    char resources[PATH_MAX], python[PATH_MAX];
    path_of(url, resources, sizeof resources);
    python_of(resources, python, sizeof python);
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends))
        return fail(cell, ERROR, "no socket for the process of the instance: %s", strerror(errno));
    char *words[] = {python, "-P", "-m", "shmio.lab.fmu.process", resources, NULL};
    cell->child = fork();
    if (!cell->child) { /* only calls that are allowed after fork() in a process with threads */
        if (ends[1] == CHILD_FD ? fcntl(CHILD_FD, F_SETFD, 0) < 0 : dup2(ends[1], CHILD_FD) < 0) _exit(127);
        execvp(python, words);
        _exit(127);
    }
    close(ends[1]);
    cell->socket = ends[0];
    if (cell->child < 0) return fail(cell, ERROR, "the process of the instance: %s", strerror(errno));
    uint32_t head[2];
    ssize_t got = recv(cell->socket, head, sizeof head, MSG_PEEK | MSG_WAITALL);
    if (got <= 0)
        return fail(cell, ERROR,
                    "%s does not run shmio: install shmio with its models' packages in that Python, or set SHMIO_PYTHON "
                    "to a Python that has them",
                    python);
    Status status = receive(cell, "start");
    if (status != OK) return status;
    if (cell->message_size != sizeof cell->counts) return fail(cell, FATAL, "start: an answer is too short");
    memcpy(cell->counts, cell->message, sizeof cell->counts);
    cell->reals = calloc(cell->counts[0] + 1u, sizeof *cell->reals);
    cell->integers = calloc(cell->counts[1] + 1u, sizeof *cell->integers);
    cell->booleans = calloc(cell->counts[2] + 1u, sizeof *cell->booleans);
    cell->strings = calloc(cell->counts[3] + 1u, sizeof *cell->strings);
    if (!cell->reals || !cell->integers || !cell->booleans || !cell->strings)
        return fail(cell, FATAL, "start: no memory");
    for (uint32_t i = 0; i < cell->counts[3]; i++)
        if (!(cell->strings[i] = strdup(""))) return fail(cell, FATAL, "start: no memory");
    return exchange(cell, HELLO, 0, 0, "start");
}

static void stop(Cell *cell)
{
    if (cell->socket >= 0) {
        uint32_t head[2] = {END, 0};
        send_all(cell->socket, head, sizeof head);
        close(cell->socket);
        cell->socket = -1;
    }
    if (cell->child <= 0) return;
    for (int waited = 0; waited < END_MS; waited += 10) {
        pid_t found = waitpid(cell->child, NULL, WNOHANG);
        if (found == cell->child || (found < 0 && errno != EINTR)) return;
        nanosleep(&(struct timespec){0, 10000000}, NULL);
    }
    kill(cell->child, SIGKILL);
    waitpid(cell->child, NULL, 0);
}

/* ---- the functions of FMI 2.0 ---- */
EXPORT String fmi2GetTypesPlatform(void) { return "default"; }
EXPORT String fmi2GetVersion(void) { return "2.0"; }

EXPORT void fmi2FreeInstance(Component component)
{
    Cell *cell = component;
    if (!cell) return;
    stop(cell);
    for (uint32_t i = 0; cell->strings && i < cell->counts[3]; i++) free(cell->strings[i]);
    free(cell->reals);
    free(cell->integers);
    free(cell->booleans);
    free(cell->strings);
    free(cell->message);
    free(cell->name);
    free(cell);
}

EXPORT Component fmi2Instantiate(String name, int type, String guid, String resources, const Callbacks *callbacks,
                                 Boolean visible, Boolean logging)
{
    (void)visible, (void)logging;
    Cell *cell = calloc(1, sizeof *cell);
    if (!cell || !callbacks) return free(cell), NULL;
    cell->callbacks = *callbacks;
    cell->socket = -1;
    cell->name = strdup(name ? name : "");
    if (type != 1 || !cell->name || !resources || !guid || strcmp(guid, SHMIO_GUID)) {
        fail(cell, ERROR, "this FMU is for co-simulation, and modelDescription.xml must be that of its library");
    } else if (start(cell, resources) == OK)
        return cell;
    fmi2FreeInstance(cell);
    return NULL;
}

EXPORT Status fmi2SetDebugLogging(Component c, Boolean on, size_t n, const String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return OK;
}

EXPORT Status fmi2SetupExperiment(Component c, Boolean d, double t, double begin, Boolean e, double end)
{
    (void)c, (void)d, (void)t, (void)e, (void)end;
    ((Cell *)c)->reals[((Cell *)c)->counts[0]] = begin; /* one more than are needed */
    return OK;
}

EXPORT Status fmi2EnterInitializationMode(Component c) { return ((Cell *)c)->status >= ERROR ? ERROR : OK; }

EXPORT Status fmi2ExitInitializationMode(Component c)
{
    Cell *cell = c;
    return exchange(cell, INITIALISE, cell->reals[cell->counts[0]], 0, "initialisation");
}

EXPORT Status fmi2DoStep(Component c, double now, double size, Boolean no_set)
{
    (void)no_set;
    return exchange(c, STEP, now, size, "step");
}

EXPORT Status fmi2Terminate(Component c)
{
    (void)c;
    return OK;
}

EXPORT Status fmi2Reset(Component c) { return fail(c, ERROR, "reset: this FMU cannot be reset; instantiate it again"); }

#define ACCESS(Type, type, field, number)                                                                             \
    EXPORT Status fmi2Get##Type(Component c, const Reference vr[], size_t n, type values[])                           \
    {                                                                                                                 \
        Cell *cell = c;                                                                                               \
        for (size_t i = 0; i < n; i++) {                                                                              \
            if (vr[i] >= cell->counts[number]) return fail(cell, ERROR, "there is no " #Type " %u", vr[i]);           \
            values[i] = cell->field[vr[i]];                                                                           \
        }                                                                                                             \
        return OK;                                                                                                    \
    }                                                                                                                 \
    EXPORT Status fmi2Set##Type(Component c, const Reference vr[], size_t n, const type values[])                     \
    {                                                                                                                 \
        Cell *cell = c;                                                                                               \
        for (size_t i = 0; i < n; i++) {                                                                              \
            if (vr[i] >= cell->counts[number]) return fail(cell, ERROR, "there is no " #Type " %u", vr[i]);           \
            cell->field[vr[i]] = values[i];                                                                           \
        }                                                                                                             \
        return OK;                                                                                                    \
    }
ACCESS(Real, double, reals, 0)
ACCESS(Integer, int, integers, 1)
ACCESS(Boolean, int, booleans, 2)

EXPORT Status fmi2GetString(Component c, const Reference vr[], size_t n, String values[])
{
    Cell *cell = c;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= cell->counts[3]) return fail(cell, ERROR, "there is no String %u", vr[i]);
        values[i] = cell->strings[vr[i]];
    }
    return OK;
}

EXPORT Status fmi2SetString(Component c, const Reference vr[], size_t n, const String values[])
{
    Cell *cell = c;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= cell->counts[3] || !values[i]) return fail(cell, ERROR, "there is no String %u", vr[i]);
        char *text = strdup(values[i]);
        if (!text) return fail(cell, FATAL, "no memory");
        free(cell->strings[vr[i]]);
        cell->strings[vr[i]] = text;
    }
    return OK;
}

/* What the description does not offer. */
#define NONE(name)                                                                                                    \
    EXPORT Status name(Component c) { return fail(c, ERROR, #name ": this FMU does not offer it"); }
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
