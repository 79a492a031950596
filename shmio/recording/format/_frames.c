/* Encodes the frames of a recording as records of MCAP. encoding.py describes the bytes.
 *
 * Limited API: one build serves CPython 3.11 and later.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <string.h>

enum {
    MESSAGE = 5,       /* opcode of a message */
    RECORD_HEAD = 9,   /* opcode and size of a record */
    MESSAGE_HEAD = 31, /* the same, channel, sequence, log time and publish time */
    FRAME_HEAD = 68,
    EFFECTIVE = 1,     /* flag: an effective image follows the raw one */
};

/* The fields of shmio.segment.Frame. */
enum { NUMBER, CYCLE, PUBLISH, CLOCK, SOURCE, INCARNATION, QUALITY, PROVENANCE, EVENT, DELAY, REASON, RAW, SEEN, FIELDS };

static uint8_t *put(uint8_t *at, uint64_t value, int size)
{
    for (int i = 0; i < size; i++) at[i] = (uint8_t)(value >> (8 * i));
    return at + size;
}

/* Appends an integer to a list; returns false with an exception. */
static int append_number(PyObject *list, uint64_t value)
{
    PyObject *number = PyLong_FromUnsignedLongLong(value);
    int done = number && PyList_Append(list, number) == 0;
    Py_XDECREF(number);
    return done;
}

/* Appends the parts of a frame's message, and returns the size of the record; 0 with an exception. */
static uint64_t add_frame(PyObject *parts, unsigned channel, uint64_t log_ns, PyObject *frame)
{
    uint64_t field[REASON];
    for (int i = 0; i < REASON; i++) {
        field[i] = PyLong_AsUnsignedLongLongMask(PyTuple_GetItem(frame, i));
        if (PyErr_Occurred()) return 0;
    }
    Py_ssize_t reason_size;
    const char *reason = PyUnicode_AsUTF8AndSize(PyTuple_GetItem(frame, REASON), &reason_size);
    if (!reason) return 0;
    PyObject *raw = PyTuple_GetItem(frame, RAW), *seen = PyTuple_GetItem(frame, SEEN);
    Py_ssize_t raw_size = PyBytes_Size(raw), seen_size = seen == Py_None ? 0 : PyBytes_Size(seen);
    if (raw_size < 0 || seen_size < 0) return 0;
    if (reason_size > UINT16_MAX || (uint64_t)raw_size > UINT32_MAX) {
        PyErr_SetString(PyExc_OverflowError, "a frame's reason or image is too long");
        return 0;
    }
    PyObject *head = PyBytes_FromStringAndSize(NULL, MESSAGE_HEAD + FRAME_HEAD + reason_size);
    if (!head) return 0;
    uint64_t size = (uint64_t)(MESSAGE_HEAD + FRAME_HEAD + reason_size) + (uint64_t)raw_size + (uint64_t)seen_size;
    uint64_t sequence = field[NUMBER] & UINT32_MAX, publish_ns = (int64_t)field[SOURCE] > 0 ? field[SOURCE] : log_ns;
    uint8_t *at = (uint8_t *)PyBytes_AsString(head);
    at = put(at, MESSAGE, 1);
    at = put(at, size - RECORD_HEAD, 8);
    at = put(at, channel, 2);
    at = put(at, sequence, 4);
    at = put(at, log_ns, 8);
    at = put(at, publish_ns, 8);
    at = put(at, field[NUMBER] - sequence, 8);
    at = put(at, field[CYCLE] - field[NUMBER], 8);
    at = put(at, field[PUBLISH] - field[CLOCK], 8);
    at = put(at, field[CLOCK] - log_ns, 8);
    at = put(at, field[SOURCE] - publish_ns, 8);
    at = put(at, field[EVENT], 8);
    at = put(at, field[INCARNATION], 4);
    at = put(at, field[QUALITY], 1);
    at = put(at, field[PROVENANCE], 1);
    at = put(at, seen == Py_None ? 0 : EFFECTIVE, 2);
    at = put(at, (uint64_t)reason_size, 2);
    at = put(at, 0, 2);
    at = put(at, (uint64_t)raw_size, 4);
    at = put(at, field[DELAY], 4);
    memcpy(at, reason, (size_t)reason_size);
    int done = PyList_Append(parts, head) == 0 && PyList_Append(parts, raw) == 0 &&
               (seen == Py_None || PyList_Append(parts, seen) == 0);
    Py_DECREF(head);
    return done ? size : 0;
}

static PyObject *frames_add(PyObject *module, PyObject *args)
{
    (void)module;
    PyObject *parts, *index, *frames;
    unsigned short channel;
    Py_ssize_t next;
    unsigned long long size, limit;
    if (!PyArg_ParseTuple(args, "O!O!HO!nKK", &PyList_Type, &parts, &PyList_Type, &index, &channel, &PyList_Type, &frames,
                          &next, &size, &limit))
        return NULL;
    if (next < 0) {
        PyErr_SetString(PyExc_ValueError, "the first frame is before the list");
        return NULL;
    }
    const Py_ssize_t old_parts = PyList_Size(parts), old_index = PyList_Size(index);
    while (next < PyList_Size(frames)) {
        PyObject *entry = PyList_GetItem(frames, next++);
        PyObject *frame = PyTuple_Check(entry) && PyTuple_Size(entry) == 2 ? PyTuple_GetItem(entry, 1) : NULL;
        if (!frame || !PyTuple_Check(frame) || PyTuple_Size(frame) != FIELDS) {
            PyErr_SetString(PyExc_TypeError, "pairs of a log time and a frame are needed");
            break;
        }
        uint64_t log_ns = PyLong_AsUnsignedLongLong(PyTuple_GetItem(entry, 0));
        if (PyErr_Occurred()) break;
        Py_INCREF(entry); /* a conversion to a number may run Python code, which may change the list */
        uint64_t added = add_frame(parts, channel, log_ns, frame);
        Py_DECREF(entry);
        if (!added || !append_number(index, log_ns) || !append_number(index, size)) break;
        size += added;
        if (size > limit) break;
    }
    if (!PyErr_Occurred()) return Py_BuildValue("nK", next, size);
    PyList_SetSlice(parts, old_parts, PyList_Size(parts), NULL); /* removes what this call has added */
    PyList_SetSlice(index, old_index, PyList_Size(index), NULL);
    return NULL;
}

static PyMethodDef functions[] = {
    {"add", frames_add, METH_VARARGS, "Add frames to a chunk, at least one, until it is too large; return the next one and the size."},
    {0},
};

static PyModuleDef_Slot module_slots[] = {{0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "shmio.recording.format._frames", "Frames of a recording.", 0, functions, module_slots,
    NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__frames(void);
PyMODINIT_FUNC PyInit__frames(void) { return PyModuleDef_Init(&definition); }
