/* Python binding of ring.h, frames.h, relay.h and queue.h (limited API: one build serves CPython 3.11 and later).
 *
 * All functions hold the GIL, except during the wait on a doorbell and in the relay. A Ring keeps its
 * buffer exported, so that the mapping cannot be closed while the Ring exists.
 */
#include <Python.h>
#include <stdlib.h>

#include "frames.h"
#include "queue.h"
#include "relay.h"
#include "ring.h"

/* ---- Ring ---------------------------------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    Py_buffer buffer;
    ring_view ring;
    uint8_t *scratch; /* for an effective image, which becomes a bytes object only if the frame has one */
    uint32_t incarnation;
} Ring;

static void Ring_dealloc(Ring *self)
{
    PyTypeObject *type = Py_TYPE((PyObject *)self);
    if (self->buffer.obj) PyBuffer_Release(&self->buffer);
    free(self->scratch);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static int Ring_init(Ring *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"buffer", "offset", "size", "private", NULL};
    PyObject *object;
    Py_ssize_t offset, size;
    int private = false;
    if (self->buffer.obj) {
        PyErr_SetString(PyExc_TypeError, "a Ring can be opened only once");
        return -1;
    }
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "Onn|p", names, &object, &offset, &size, &private)) return -1;
    if (PyObject_GetBuffer(object, &self->buffer, PyBUF_SIMPLE) < 0) return -1;
    if (offset < 0 || size < 0 || offset > self->buffer.len || size > self->buffer.len - offset) {
        PyErr_SetString(PyExc_ValueError, "ring lies outside the buffer");
        return -1;
    }
    const char *wrong = ring_open(&self->ring, (uint8_t *)self->buffer.buf + offset, (uint64_t)size);
    if (wrong) {
        PyErr_SetString(PyExc_ValueError, wrong);
        return -1;
    }
    if (private && self->buffer.readonly) {
        PyErr_SetString(PyExc_ValueError, "threads that wait on a private ring write to it, so its buffer must be writable");
        return -1;
    }
    self->ring.private = private;
    self->scratch = malloc(align8(self->ring.frame_size));
    if (!self->scratch) {
        PyErr_NoMemory();
        return -1;
    }
    return 0;
}

static bool Ring_ready(Ring *self)
{
    if (self->scratch) return true;
    PyErr_SetString(PyExc_ValueError, "the ring is not open");
    return false;
}

static bool Ring_writable(Ring *self)
{
    if (!Ring_ready(self)) return false;
    if (!self->buffer.readonly) return true;
    PyErr_SetString(PyExc_TypeError, "the segment is mapped read-only");
    return false;
}

/* Returns true if frames may be written; else false with an exception. */
static bool Ring_begun(Ring *self)
{
    if (!Ring_writable(self)) return false;
    if (self->incarnation) return true;
    PyErr_SetString(PyExc_ValueError, "call begin() before the first publish()");
    return false;
}

static PyObject *Ring_begin(Ring *self, PyObject *args)
{
    a32 *stored = &ring_head(&self->ring)->incarnation;
    unsigned int incarnation = 0;
    if (!PyArg_ParseTuple(args, "|I", &incarnation) || !Ring_writable(self)) return NULL;
    /* Only the writer changes this word. Readers find the incarnation of a frame in the frame. */
    if (!incarnation) incarnation = atomic_load_explicit(stored, memory_order_relaxed) + 1;
    self->incarnation = incarnation;
    atomic_store_explicit(stored, incarnation, memory_order_relaxed);
    return PyLong_FromUnsignedLong(self->incarnation);
}

/* Reads the numbers of a frame: cycle, publish_ns, clock_ns, source_ns, quality, provenance, event, delay_us. Returns
 * false with an exception. */
static bool frame_numbers(PyObject *const *args, slot_info *info)
{
    long long times[3];
    unsigned long bytes[2];
    info->cycle = PyLong_AsUnsignedLongLongMask(args[0]);
    if (PyErr_Occurred()) return false;
    for (int i = 0; i < 3; i++) {
        times[i] = PyLong_AsLongLong(args[1 + i]);
        if (times[i] == -1 && PyErr_Occurred()) return false;
    }
    for (int i = 0; i < 2; i++) {
        bytes[i] = PyLong_AsUnsignedLong(args[4 + i]);
        if (bytes[i] == (unsigned long)-1 && PyErr_Occurred()) return false;
        if (bytes[i] > UINT8_MAX) {
            PyErr_SetString(PyExc_OverflowError, "quality and provenance are at most 255");
            return false;
        }
    }
    info->event = PyLong_AsUnsignedLongLongMask(args[6]);
    if (PyErr_Occurred()) return false;
    info->delay_us = (uint32_t)PyLong_AsUnsignedLongMask(args[7]);
    if (PyErr_Occurred()) return false;
    info->publish_ns = times[0];
    info->clock_ns = times[1];
    info->source_ns = times[2];
    info->quality = (uint8_t)bytes[0];
    info->provenance = (uint8_t)bytes[1];
    return true;
}

static PyObject *Ring_publish(Ring *self, PyObject *const *args, Py_ssize_t given)
{
    Py_buffer raw = {0}, reason = {0}, effective = {0};
    PyObject *result = NULL;
    slot_info info = {0};
    if (given != 11) {
        PyErr_SetString(PyExc_TypeError, "two images, eight numbers and a reason are needed");
        return NULL;
    }
    if (!frame_numbers(args + 2, &info)) return NULL;
    if (PyObject_GetBuffer(args[0], &raw, PyBUF_SIMPLE) < 0) goto done;
    if (args[1] != Py_None && PyObject_GetBuffer(args[1], &effective, PyBUF_SIMPLE) < 0) goto done;
    if (PyObject_GetBuffer(args[10], &reason, PyBUF_SIMPLE) < 0) goto done;
    if (!Ring_begun(self)) goto done;
    if (raw.len != self->ring.frame_size || (effective.obj && effective.len != self->ring.frame_size)) {
        PyErr_Format(PyExc_ValueError, "a frame of this ring has %u bytes", self->ring.frame_size);
        goto done;
    }
    info.incarnation = self->incarnation;
    info.reason_size = (uint16_t)(reason.len < (Py_ssize_t)REASON_SIZE ? reason.len : (Py_ssize_t)REASON_SIZE);
    if (effective.obj && !self->ring.effective_offset) {
        PyErr_SetString(PyExc_ValueError, "this ring has no room for an effective image");
        goto done;
    }
    result = PyLong_FromUnsignedLongLong(ring_publish(&self->ring, info, reason.buf, raw.buf, effective.buf));
done:
    if (effective.obj) PyBuffer_Release(&effective);
    if (reason.obj) PyBuffer_Release(&reason);
    if (raw.obj) PyBuffer_Release(&raw);
    return result;
}

static PyObject *Ring_head(Ring *self, PyObject *unused)
{
    (void)unused;
    if (!Ring_ready(self)) return NULL;
    return PyLong_FromUnsignedLongLong(atomic_load_explicit(&ring_head(&self->ring)->head, memory_order_acquire));
}

/* What a copy of a frame becomes in Python: a tuple, or an object of a subclass with decoded fields. */
typedef struct {
    PyTypeObject *type;
    PyObject *qualities, *provenances; /* tuples of 256 values; NULL: the numbers themselves */
} frame_form;

static PyObject *decoded(PyObject *values, uint8_t number)
{
    if (!values) return PyLong_FromLong(number);
    PyObject *value = PyTuple_GetItem(values, number);
    Py_XINCREF(value);
    return value;
}

/* Returns a tuple as an object of a subclass, and releases the tuple. */
static PyObject *as_type(PyTypeObject *type, PyObject *tuple)
{
    newfunc make = (newfunc)PyType_GetSlot(&PyTuple_Type, Py_tp_new);
    PyObject *args = PyTuple_Pack(1, tuple);
    PyObject *object = args ? make(type, args, NULL) : NULL;
    Py_XDECREF(args);
    Py_DECREF(tuple);
    return object;
}

/* Copies a frame: (frame, cycle, publish_ns, clock_ns, source_ns, incarnation, quality, provenance, event,
 * delay_us, reason, raw, effective). Returns None if the ring does not have the frame. */
static PyObject *Ring_copy(Ring *self, const frame_form *form, bool latest, uint64_t frame)
{
    slot_info info;
    uint8_t reason[REASON_SIZE];
    PyObject *raw = PyBytes_FromStringAndSize(NULL, self->ring.frame_size);
    if (!raw) return NULL;
    uint8_t *data = (uint8_t *)PyBytes_AsString(raw);
    if (latest)
        frame = ring_latest(&self->ring, &info, reason, data, self->scratch);
    else if (!ring_read(&self->ring, frame, &info, reason, data, self->scratch))
        frame = 0;
    if (frame == 0) {
        Py_DECREF(raw);
        Py_RETURN_NONE;
    }
    PyObject *effective = Py_None;
    if (info.flags & FLAG_EFFECTIVE)
        effective = PyBytes_FromStringAndSize((const char *)self->scratch, self->ring.frame_size);
    else
        Py_INCREF(Py_None);
    PyObject *fields[] = {
        PyLong_FromUnsignedLongLong(frame),
        PyLong_FromUnsignedLongLong(info.cycle),
        PyLong_FromLongLong(info.publish_ns),
        PyLong_FromLongLong(info.clock_ns),
        PyLong_FromLongLong(info.source_ns),
        PyLong_FromUnsignedLong(info.incarnation),
        decoded(form->qualities, info.quality),
        decoded(form->provenances, info.provenance),
        PyLong_FromUnsignedLongLong(info.event),
        PyLong_FromUnsignedLong(info.delay_us),
        PyUnicode_DecodeUTF8((const char *)reason, info.reason_size, "replace"),
        raw,
        effective,
    };
    Py_ssize_t count = sizeof fields / sizeof *fields;
    /* Since Python 3.14, a tuple caches its hash, and only tuple.__new__ prepares that; before, this is faster. */
    bool direct = form->type == &PyTuple_Type || Py_Version < 0x030E0000;
    PyObject *copy = direct && form->type != &PyTuple_Type ? PyType_GenericAlloc(form->type, count) : PyTuple_New(count);
    for (Py_ssize_t i = 0; i < count; i++) {
        if (copy && fields[i])
            PyTuple_SetItem(copy, i, fields[i]);
        else {
            Py_XDECREF(fields[i]);
            Py_CLEAR(copy);
        }
    }
    return copy && !direct ? as_type(form->type, copy) : copy;
}

static const frame_form undecoded = {&PyTuple_Type, NULL, NULL};

static PyObject *Ring_latest(Ring *self, PyObject *unused)
{
    (void)unused;
    return Ring_ready(self) ? Ring_copy(self, &undecoded, true, 0) : NULL;
}

static PyObject *Ring_read(Ring *self, PyObject *number)
{
    if (!Ring_ready(self)) return NULL;
    unsigned long long frame = PyLong_AsUnsignedLongLong(number);
    if (PyErr_Occurred()) return NULL;
    if (!ring_may_have(frame)) Py_RETURN_NONE;
    return Ring_copy(self, &undecoded, false, frame);
}

static PyObject *Ring_read_many(Ring *self, PyObject *args)
{
    unsigned long long first;
    Py_ssize_t count;
    frame_form form;
    PyObject *type;
    if (!PyArg_ParseTuple(args, "KnO!O!O!", &first, &count, &PyType_Type, &type, &PyTuple_Type, &form.qualities,
                          &PyTuple_Type, &form.provenances) ||
        !Ring_ready(self))
        return NULL;
    form.type = (PyTypeObject *)type;
    if (!PyType_IsSubtype(form.type, &PyTuple_Type) || PyTuple_Size(form.qualities) != 256 ||
        PyTuple_Size(form.provenances) != 256) {
        PyErr_SetString(PyExc_TypeError, "a subclass of tuple and two tuples of 256 values are needed");
        return NULL;
    }
    PyObject *copies = PyList_New(0);
    for (unsigned long long frame = first; copies && count > 0 && ring_may_have(frame); count--, frame++) {
        PyObject *copy = Ring_copy(self, &form, false, frame);
        bool gone = copy == Py_None;
        if (!copy || (!gone && PyList_Append(copies, copy) < 0)) Py_CLEAR(copies);
        Py_XDECREF(copy);
        if (gone) break;
    }
    return copies;
}

/* Returns (entries, last, clock_ns). If there are no entries, last is `after`, and clock_ns is 0. */
static PyObject *Ring_pack(Ring *self, PyObject *args)
{
    unsigned long long after, event;
    unsigned int limit;
    if (!PyArg_ParseTuple(args, "KKI", &after, &event, &limit) || !Ring_ready(self)) return NULL;
    uint64_t head = atomic_load_explicit(&ring_head(&self->ring)->head, memory_order_acquire);
    uint64_t count = after < head ? head - after : 0;
    if (count > limit) count = limit;
    uint64_t room = count * frames_entry_size(&self->ring);
    if (room > PY_SSIZE_T_MAX) return PyErr_NoMemory();
    PyObject *entries = PyByteArray_FromStringAndSize(NULL, (Py_ssize_t)room);
    if (!entries) return NULL;
    uint64_t last = after;
    int64_t clock_ns = 0;
    size_t size = frames_pack(&self->ring, event, (uint8_t *)PyByteArray_AsString(entries), room, &last, &clock_ns);
    if (PyByteArray_Resize(entries, (Py_ssize_t)size) < 0) {
        Py_DECREF(entries);
        return NULL;
    }
    return Py_BuildValue("NKL", entries, (unsigned long long)last, (long long)clock_ns);
}

/* Returns (count, last, end). If there is no plain frame at the position, count is 0, and the others are the position. */
static PyObject *Ring_publish_packed(Ring *self, PyObject *args)
{
    Py_buffer data;
    Py_ssize_t at;
    unsigned long long number, event, late_ns;
    long long publish_ns, clock_ns, made_ns;
    PyObject *result = NULL;
    if (!PyArg_ParseTuple(args, "y*nKLLKLK", &data, &at, &number, &publish_ns, &clock_ns, &event, &made_ns, &late_ns))
        return NULL;
    if (!Ring_begun(self)) goto done;
    if (at < 0 || at > data.len) {
        PyErr_SetString(PyExc_ValueError, "outside the message");
        goto done;
    }
    slot_info stamp = {.publish_ns = publish_ns, .clock_ns = clock_ns, .event = event, .incarnation = self->incarnation};
    size_t last = 0, end = 0;
    uint32_t count = frames_publish(&self->ring, (const uint8_t *)data.buf + at, (size_t)(data.len - at), number, stamp,
                                    made_ns, late_ns, &last, &end);
    result = Py_BuildValue("Inn", count, at + (Py_ssize_t)last, at + (Py_ssize_t)end);
done:
    PyBuffer_Release(&data);
    return result;
}

static PyObject *Ring_doorbell(Ring *self, PyObject *unused)
{
    (void)unused;
    if (!Ring_ready(self)) return NULL;
    return PyLong_FromUnsignedLong(atomic_load_explicit(&ring_head(&self->ring)->doorbell, memory_order_acquire));
}

static PyObject *Ring_wake(Ring *self, PyObject *unused)
{
    (void)unused;
    if (!Ring_writable(self)) return NULL;
    ring_wake(&self->ring);
    Py_RETURN_NONE;
}

/* Waits without the GIL, and returns the word's value. A signal also ends the wait; its Python handler
 * runs first. */
static PyObject *wait_on(const a32 *word, a32 *waiters, unsigned int seen, long long timeout_ns)
{
    int error;
    Py_BEGIN_ALLOW_THREADS
    error = doorbell_wait(word, waiters, seen, timeout_ns);
    Py_END_ALLOW_THREADS
    if (error == EINTR && PyErr_CheckSignals() < 0) return NULL;
    if (error && error != EINTR && error != ETIMEDOUT) {
        errno = error;
        return PyErr_SetFromErrno(PyExc_OSError);
    }
    return PyLong_FromUnsignedLong(atomic_load_explicit(word, memory_order_acquire));
}

static PyObject *Ring_wait(Ring *self, PyObject *args)
{
    unsigned int seen;
    long long timeout_ns;
    if (!PyArg_ParseTuple(args, "IL", &seen, &timeout_ns)) return NULL;
    if (!Ring_ready(self)) return NULL;
    return wait_on(&ring_head(&self->ring)->doorbell, ring_waiters(&self->ring), seen, timeout_ns);
}

/* Returns the relay in a buffer, which the caller must release; NULL with an exception. */
static relay *relay_in(PyObject *object, Py_buffer *buffer)
{
    if (PyObject_GetBuffer(object, buffer, PyBUF_WRITABLE) < 0) return NULL;
    if (buffer->len == sizeof(relay) && (uintptr_t)buffer->buf % _Alignof(relay) == 0) return buffer->buf;
    PyBuffer_Release(buffer);
    PyErr_Format(PyExc_ValueError, "a relay needs %zu aligned bytes", sizeof(relay));
    return NULL;
}

static PyObject *relay_on(const a32 *word, a32 *waiters, PyObject *object, int descriptor, long long turn_ns)
{
    Py_buffer buffer;
    relay *shared = relay_in(object, &buffer);
    if (!shared) return NULL;
    Py_BEGIN_ALLOW_THREADS
    relay_run(shared, word, waiters, descriptor, turn_ns);
    Py_END_ALLOW_THREADS
    PyBuffer_Release(&buffer);
    Py_RETURN_NONE;
}

static PyObject *Ring_relay(Ring *self, PyObject *args)
{
    PyObject *shared;
    int descriptor;
    long long turn_ns;
    if (!PyArg_ParseTuple(args, "OiL", &shared, &descriptor, &turn_ns)) return NULL;
    if (!Ring_ready(self)) return NULL;
    return relay_on(&ring_head(&self->ring)->doorbell, ring_waiters(&self->ring), shared, descriptor, turn_ns);
}

static PyObject *Ring_get(Ring *self, void *field)
{
    if (!Ring_ready(self)) return NULL;
    const uint8_t *at = self->ring.base + (uintptr_t)field;
    if ((uintptr_t)field < offsetof(ring_header, period_ns)) return PyLong_FromUnsignedLong(*(const uint32_t *)(const void *)at);
    return PyLong_FromLongLong(*(const int64_t *)(const void *)at);
}

#define FIELD(name, doc) {#name, (getter)Ring_get, NULL, doc, (void *)offsetof(ring_header, name)}
static PyObject *Ring_incarnation(Ring *self, void *unused)
{
    (void)unused;
    if (!Ring_ready(self)) return NULL;
    return PyLong_FromUnsignedLong(atomic_load_explicit(&ring_head(&self->ring)->incarnation, memory_order_relaxed));
}

static PyGetSetDef Ring_fields[] = {
    FIELD(slot_count, "Number of frames for which the ring has room."),
    FIELD(frame_size, "Size of an image in bytes."),
    FIELD(period_ns, "Time between two cycles of the source, in ns."),
    FIELD(stale_ns, "Age above which a frame is bad, in ns."),
    {"incarnation", (getter)Ring_incarnation, NULL, "Number of the process that writes the ring, counted from 1.", NULL},
    {0},
};

#define METHOD(type, name, flags, doc) {#name, (PyCFunction)(void (*)(void))type##_##name, flags, doc}
static PyMethodDef Ring_methods[] = {
    METHOD(Ring, begin, METH_VARARGS, "Start to write with the next incarnation, or the given one; return it."),
    METHOD(Ring, publish, METH_FASTCALL, "Write the next frame, wake all waiters, and return the frame's number."),
    METHOD(Ring, head, METH_NOARGS, "Return the number of the newest complete frame; 0: there is none yet."),
    METHOD(Ring, latest, METH_NOARGS, "Return a validated copy of the newest frame, or None."),
    METHOD(Ring, read, METH_O, "Return a validated copy of one frame; None if it is not in the ring."),
    METHOD(Ring, pack, METH_VARARGS, "Return plain frames after a number and an event as entries, last number and clock."),
    METHOD(Ring, publish_packed, METH_VARARGS, "Write the plain frames at a position; return how many, last position, end."),
    METHOD(Ring, read_many, METH_VARARGS, "Return copies of the frames from `first` on, up to one that is not in the ring."),
    METHOD(Ring, doorbell, METH_NOARGS, "Return the value of the futex word. Read it before you check for changes."),
    METHOD(Ring, wake, METH_NOARGS, "Ring the doorbell without a new frame, for another change."),
    METHOD(Ring, wait, METH_VARARGS, "Wait until the doorbell is not `seen`, at most `timeout_ns`; return its value."),
    METHOD(Ring, relay, METH_VARARGS, "Signal each ring of the doorbell to an event loop, until stopped."),
    {0},
};

static PyType_Slot Ring_slots[] = {
    {Py_tp_doc, "A ring of frames or events in a mapped segment."},
    {Py_tp_init, Ring_init},
    {Py_tp_dealloc, Ring_dealloc},
    {Py_tp_methods, Ring_methods},
    {Py_tp_getset, Ring_fields},
    {0, NULL},
};
static PyType_Spec Ring_spec = {"shmio.segment._atomics.Ring", sizeof(Ring), 0, Py_TPFLAGS_DEFAULT, Ring_slots};

/* ---- words and cells ----------------------------------------------------------------------------------------------- */

/* Returns the place of `size` aligned bytes in a buffer, or NULL with an exception. */
static uint8_t *place(const Py_buffer *buffer, Py_ssize_t offset, Py_ssize_t size, Py_ssize_t alignment)
{
    if (offset < 0 || size < 0 || size > buffer->len || offset > buffer->len - size) {
        PyErr_SetString(PyExc_ValueError, "outside the buffer");
        return NULL;
    }
    uint8_t *at = (uint8_t *)buffer->buf + offset;
    if ((uintptr_t)at % (uintptr_t)alignment) {
        PyErr_SetString(PyExc_ValueError, "not aligned");
        return NULL;
    }
    return at;
}

static PyObject *atomics_load64(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset;
    if (!PyArg_ParseTuple(args, "y*n", &buffer, &offset)) return NULL;
    a64 *at = (a64 *)(void *)place(&buffer, offset, 8, 8);
    uint64_t value = at ? atomic_load_explicit(at, memory_order_acquire) : 0;
    PyBuffer_Release(&buffer);
    return at ? PyLong_FromUnsignedLongLong(value) : NULL;
}

static PyObject *atomics_store64(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset;
    unsigned long long value;
    if (!PyArg_ParseTuple(args, "w*nK", &buffer, &offset, &value)) return NULL;
    a64 *at = (a64 *)(void *)place(&buffer, offset, 8, 8);
    if (at) atomic_store_explicit(at, value, memory_order_release); /* pairs with load64 */
    PyBuffer_Release(&buffer);
    if (!at) return NULL;
    Py_RETURN_NONE;
}

static PyObject *atomics_cell_write(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer, data;
    Py_ssize_t offset;
    if (!PyArg_ParseTuple(args, "w*ny*", &buffer, &offset, &data)) return NULL;
    uint8_t *cell = data.len < PY_SSIZE_T_MAX - 16 ? place(&buffer, offset, 8 + (Py_ssize_t)align8((uint64_t)data.len), 8) : NULL;
    if (cell) cell_write(cell, data.buf, (size_t)data.len);
    PyBuffer_Release(&buffer);
    PyBuffer_Release(&data);
    if (!cell) return PyErr_Occurred() ? NULL : PyErr_NoMemory();
    Py_RETURN_NONE;
}

static PyObject *atomics_cells_write(PyObject *module, PyObject *const *args, Py_ssize_t given)
{
    (void)module;
    Py_buffer buffer, data;
    if (given != 3 || !PyTuple_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "a buffer, a tuple of offsets and data are needed");
        return NULL;
    }
    if (PyObject_GetBuffer(args[0], &buffer, PyBUF_WRITABLE) < 0) return NULL;
    if (PyObject_GetBuffer(args[2], &data, PyBUF_SIMPLE) < 0) {
        PyBuffer_Release(&buffer);
        return NULL;
    }
    for (Py_ssize_t i = 0; i < PyTuple_Size(args[1]); i++) {
        Py_ssize_t offset = PyLong_AsSsize_t(PyTuple_GetItem(args[1], i)), most = buffer.len - 8;
        if (offset == -1 && PyErr_Occurred()) break;
        uint8_t *cell = data.len > most ? place(&buffer, 0, PY_SSIZE_T_MAX, 8)
                                        : place(&buffer, offset, 8 + (Py_ssize_t)align8((uint64_t)data.len), 8);
        if (!cell) break;
        cell_write(cell, data.buf, (size_t)data.len);
    }
    PyBuffer_Release(&buffer);
    PyBuffer_Release(&data);
    if (PyErr_Occurred()) return NULL;
    Py_RETURN_NONE;
}

static PyObject *atomics_cell_read(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset, size;
    if (!PyArg_ParseTuple(args, "y*nn", &buffer, &offset, &size)) return NULL;
    PyObject *data = NULL;
    uint8_t *cell = NULL;
    if (size < 0 || size > buffer.len)
        PyErr_SetString(PyExc_ValueError, "outside the buffer");
    else
        cell = place(&buffer, offset, 8 + (Py_ssize_t)align8((uint64_t)size), 8);
    if (cell && (data = PyBytes_FromStringAndSize(NULL, size)) != NULL &&
        !cell_read(cell, (uint8_t *)PyBytes_AsString(data), (size_t)size)) {
        Py_DECREF(data);
        Py_INCREF(Py_None);
        data = Py_None;
    }
    PyBuffer_Release(&buffer);
    return data;
}

/* ---- doorbells and queues ------------------------------------------------------------------------------------------- */

static PyObject *atomics_bell(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset;
    if (!PyArg_ParseTuple(args, "y*n", &buffer, &offset)) return NULL;
    a32 *at = (a32 *)(void *)place(&buffer, offset, 4, 4);
    uint32_t value = at ? atomic_load_explicit(at, memory_order_acquire) : 0;
    PyBuffer_Release(&buffer);
    return at ? PyLong_FromUnsignedLong(value) : NULL;
}

static PyObject *atomics_bell_ring(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset;
    if (!PyArg_ParseTuple(args, "w*n", &buffer, &offset)) return NULL;
    a32 *at = (a32 *)(void *)place(&buffer, offset, 4, 4);
    if (at) doorbell_ring(at);
    PyBuffer_Release(&buffer);
    if (!at) return NULL;
    Py_RETURN_NONE;
}

static PyObject *atomics_bell_wait(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset;
    unsigned int seen;
    long long timeout_ns;
    if (!PyArg_ParseTuple(args, "y*nIL", &buffer, &offset, &seen, &timeout_ns)) return NULL;
    const a32 *at = (const a32 *)(void *)place(&buffer, offset, 4, 4);
    PyObject *value = at ? wait_on(at, NULL, seen, timeout_ns) : NULL; /* the buffer stays exported */
    PyBuffer_Release(&buffer);
    return value;
}

static PyObject *atomics_bell_relay(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset;
    PyObject *shared;
    int descriptor;
    long long turn_ns;
    if (!PyArg_ParseTuple(args, "y*nOiL", &buffer, &offset, &shared, &descriptor, &turn_ns)) return NULL;
    const a32 *at = (const a32 *)(void *)place(&buffer, offset, 4, 4);
    PyObject *result = at ? relay_on(at, NULL, shared, descriptor, turn_ns) : NULL; /* the buffer stays exported */
    PyBuffer_Release(&buffer);
    return result;
}

static PyObject *atomics_relay_heard(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    PyObject *object;
    int descriptor;
    if (!PyArg_ParseTuple(args, "Oi", &object, &descriptor)) return NULL;
    relay *shared = relay_in(object, &buffer);
    if (!shared) return NULL;
    relay_heard(shared, descriptor);
    PyBuffer_Release(&buffer);
    Py_RETURN_NONE;
}

static PyObject *atomics_relay_stop(PyObject *module, PyObject *object)
{
    (void)module;
    Py_buffer buffer;
    relay *shared = relay_in(object, &buffer);
    if (!shared) return NULL;
    relay_stop(shared);
    PyBuffer_Release(&buffer);
    Py_RETURN_NONE;
}

/* Returns the queue at `offset` with `capacity` bytes of data, or NULL with an exception. */
static uint8_t *queue_place(const Py_buffer *buffer, Py_ssize_t offset, Py_ssize_t capacity)
{
    if (capacity < 64 || capacity > (1 << 30) || (capacity & (capacity - 1)) != 0) {
        PyErr_SetString(PyExc_ValueError, "capacity is not a power of two in 64..2^30");
        return NULL;
    }
    return place(buffer, offset, (Py_ssize_t)QUEUE_HEADER_SIZE + capacity, 8);
}

static PyObject *atomics_queue_push(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer, record;
    Py_ssize_t offset, capacity;
    if (!PyArg_ParseTuple(args, "w*nny*", &buffer, &offset, &capacity, &record)) return NULL;
    uint8_t *queue = queue_place(&buffer, offset, capacity);
    bool room = queue && record.len <= capacity && queue_push(queue, (uint64_t)capacity, record.buf, (uint32_t)record.len);
    PyBuffer_Release(&buffer);
    PyBuffer_Release(&record);
    return queue ? PyBool_FromLong(room) : NULL;
}

static PyObject *atomics_queue_pop(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer buffer;
    Py_ssize_t offset, capacity;
    if (!PyArg_ParseTuple(args, "w*nn", &buffer, &offset, &capacity)) return NULL;
    PyObject *record = NULL;
    uint32_t size = 0;
    uint8_t *queue = queue_place(&buffer, offset, capacity);
    if (!queue) goto done;
    switch (queue_peek(queue, (uint64_t)capacity, &size)) {
    case QUEUE_EMPTY:
        Py_INCREF(Py_None);
        record = Py_None;
        break;
    case QUEUE_RECORD:
        record = PyBytes_FromStringAndSize(NULL, size);
        if (record) queue_drop(queue, (uint64_t)capacity, (uint8_t *)PyBytes_AsString(record), size);
        break;
    case QUEUE_BROKEN:
        queue_clear(queue);
        PyErr_SetString(PyExc_ValueError, "the queue was corrupt and has been emptied");
    }
done:
    PyBuffer_Release(&buffer);
    return record;
}

/* ---- changed registers --------------------------------------------------------------------------------------------- */

#define CHUNK 64u

typedef struct {
    uint32_t offset;
    uint32_t size;
    uint32_t mask;  /* bits of the one byte to compare; 0: compare all bytes */
    uint32_t index; /* number to report; entries with the same index are adjacent */
} scan_entry;

/* Returns whether the bytes of an entry differ. `dirty` says which chunks of the image differ. */
static bool entry_changed(const scan_entry *entry, const uint8_t *old, const uint8_t *new, const uint8_t *dirty)
{
    uint32_t last = (entry->offset + entry->size - 1) / CHUNK;
    for (uint32_t chunk = entry->offset / CHUNK; !dirty[chunk]; chunk++)
        if (chunk == last) return false;
    if (entry->mask) return ((old[entry->offset] ^ new[entry->offset]) & entry->mask) != 0;
    return memcmp(old + entry->offset, new + entry->offset, entry->size) != 0;
}

static PyObject *atomics_changed(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer old, new, table;
    PyObject *result = NULL;
    uint8_t stack[1024], *dirty = stack;
    if (!PyArg_ParseTuple(args, "y*y*y*", &old, &new, &table)) return NULL;
    const scan_entry *entries = table.buf;
    Py_ssize_t count = table.len / (Py_ssize_t)sizeof *entries;
    if (old.len != new.len || table.len % (Py_ssize_t)sizeof *entries || (uintptr_t)table.buf % 4) {
        PyErr_SetString(PyExc_ValueError, "two images of one size and a table of (offset, size, mask, index) are needed");
        goto done;
    }
    result = PyList_New(0);
    if (!result || memcmp(old.buf, new.buf, (size_t)old.len) == 0) goto done;
    size_t chunks = ((size_t)old.len + CHUNK - 1) / CHUNK;
    if (chunks > sizeof stack && !(dirty = malloc(chunks))) {
        Py_CLEAR(result);
        PyErr_NoMemory();
        goto done;
    }
    for (size_t chunk = 0; chunk < chunks; chunk++) {
        size_t at = chunk * CHUNK, rest = (size_t)old.len - at;
        dirty[chunk] = memcmp((uint8_t *)old.buf + at, (uint8_t *)new.buf + at, rest < CHUNK ? rest : CHUNK) != 0;
    }
    uint64_t reported = UINT64_MAX;
    for (Py_ssize_t i = 0; i < count; i++) {
        const scan_entry *entry = &entries[i];
        if (entry->size == 0 || (uint64_t)entry->offset + entry->size > (uint64_t)old.len) {
            PyErr_Format(PyExc_ValueError, "entry %zd lies outside the image", i);
            Py_CLEAR(result);
            break;
        }
        if (entry->index == reported || !entry_changed(entry, old.buf, new.buf, dirty)) continue;
        reported = entry->index;
        PyObject *index = PyLong_FromUnsignedLong(entry->index);
        if (!index || PyList_Append(result, index) < 0) {
            Py_XDECREF(index);
            Py_CLEAR(result);
            break;
        }
        Py_DECREF(index);
    }
    if (dirty != stack) free(dirty);
done:
    PyBuffer_Release(&old);
    PyBuffer_Release(&new);
    PyBuffer_Release(&table);
    return result;
}

/* ---- module -------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    METHOD(atomics, load64, METH_VARARGS, "Acquire load of an aligned 64-bit word."),
    METHOD(atomics, store64, METH_VARARGS, "Release store of an aligned 64-bit word."),
    METHOD(atomics, cell_write, METH_VARARGS, "Write a cell. It may have only one writer."),
    METHOD(atomics, cells_write, METH_FASTCALL, "Write the same data to several cells, one after another."),
    METHOD(atomics, cell_read, METH_VARARGS, "Return a consistent copy of a cell; None while it is being written."),
    METHOD(atomics, bell, METH_VARARGS, "Return the value of a futex word. Read it before you check for changes."),
    METHOD(atomics, bell_ring, METH_VARARGS, "Increment a futex word, and wake all that wait on it."),
    METHOD(atomics, bell_wait, METH_VARARGS, "Wait until a word is not `seen`, at most `timeout_ns`; return its value."),
    METHOD(atomics, bell_relay, METH_VARARGS, "Signal each ring of a futex word to an event loop, until stopped."),
    METHOD(atomics, relay_heard, METH_VARARGS, "Acknowledge a notification. Call this before you check for changes."),
    METHOD(atomics, relay_stop, METH_O, "Stop a relay: it signals nothing more, and returns."),
    METHOD(atomics, queue_push, METH_VARARGS, "Append a record to a queue; return False if there is no room."),
    METHOD(atomics, queue_pop, METH_VARARGS, "Remove and return the oldest record, or None; ValueError: corrupt, now empty."),
    METHOD(atomics, changed, METH_VARARGS, "Return the indices of a table's entries whose bytes differ in two images."),
    {0},
};

static int module_exec(PyObject *module)
{
    PyObject *type = PyType_FromModuleAndSpec(module, &Ring_spec, NULL);
    if (!type) return -1;
    int result = PyModule_AddObjectRef(module, "Ring", type);
    Py_DECREF(type);
    if (result < 0) return -1;
    return PyModule_AddIntConstant(module, "RING_HEADER_SIZE", RING_HEADER_SIZE) < 0 ||
                   PyModule_AddIntConstant(module, "QUEUE_HEADER_SIZE", QUEUE_HEADER_SIZE) < 0 ||
                   PyModule_AddIntConstant(module, "RAW_OFFSET", RAW_OFFSET) < 0 ||
                   PyModule_AddIntConstant(module, "REASON_SIZE", REASON_SIZE) < 0 ||
                   PyModule_AddIntConstant(module, "RELAY_SIZE", sizeof(relay)) < 0
               ? -1
               : 0;
}

static PyModuleDef_Slot module_slots[] = {{Py_mod_exec, module_exec}, {0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "shmio.segment._atomics", "Atomics for the shared-memory segment.", 0, functions, module_slots,
    NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__atomics(void);
PyMODINIT_FUNC PyInit__atomics(void) { return PyModuleDef_Init(&definition); }
