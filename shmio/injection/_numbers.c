/* Numbers in the images of a block: reads them, changes them, and evaluates conditions over them.
 *
 * Limited API: one build serves CPython 3.11 and later. Conditions compute with Python's own numbers, so they
 * mean the same as in Python; but where Python would round a large integer to a float, they compute exactly (exact.py).
 */
#include <Python.h>
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

/* ---- numbers in images --------------------------------------------------------------------------------------------- */

typedef struct {
    PyObject_HEAD
    Py_ssize_t offset, size;
    char code;       /* as in Python's struct; ?: one bit */
    uint8_t mask;    /* the bit, for ? */
    bool big;        /* the byte order in the image */
    double minimum, maximum; /* the range for changes */
} Number;

#define REAL_MAX 3.4028234663852886e38
#define LREAL_MAX 1.7976931348623157e308

/* The types of numbers. A double cannot represent the range of those with the range 0. */
static const struct {
    char code;
    Py_ssize_t size;
    double minimum, maximum;
} types[] = {
    {'?', 1, 0, 0},
    {'b', 1, INT8_MIN, INT8_MAX},
    {'B', 1, 0, UINT8_MAX},
    {'h', 2, INT16_MIN, INT16_MAX},
    {'H', 2, 0, UINT16_MAX},
    {'i', 4, INT32_MIN, INT32_MAX},
    {'I', 4, 0, UINT32_MAX},
    {'q', 8, 0, 0},
    {'Q', 8, 0, 0},
    {'f', 4, -REAL_MAX, REAL_MAX},
    {'d', 8, -LREAL_MAX, LREAL_MAX},
};
enum { TYPE_COUNT = sizeof types / sizeof *types };

static void Number_dealloc(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

static int Number_init(Number *self, PyObject *args, PyObject *kwargs)
{
    const char *format;
    Py_ssize_t offset;
    int bit = 0;
    if (kwargs && PyDict_Size(kwargs)) {
        PyErr_SetString(PyExc_TypeError, "Number takes no keyword arguments");
        return -1;
    }
    if (!PyArg_ParseTuple(args, "sn|i", &format, &offset, &bit)) return -1;
    size_t type = 0;
    bool ordered = format[0] == '<' || format[0] == '>';
    while (type < TYPE_COUNT && !(ordered && format[1] == types[type].code && !format[2])) type++;
    if (type == TYPE_COUNT) {
        PyErr_Format(PyExc_ValueError, "the format is not < or > and one of ?bBhHiIqQfd: %s", format);
        return -1;
    }
    if (offset < 0 || bit < 0 || bit > 7) {
        PyErr_Format(PyExc_ValueError, "the offset is negative, or the bit is not in 0..7: %zd, %d", offset, bit);
        return -1;
    }
    self->offset = offset;
    self->size = types[type].size;
    self->minimum = types[type].minimum;
    self->maximum = types[type].maximum;
    self->code = types[type].code;
    self->big = format[0] == '>';
    self->mask = (uint8_t)(1u << bit);
    return 0;
}

/* Returns the number's bytes in an image, or NULL with an exception. */
static uint8_t *number_at(const Number *self, const Py_buffer *image)
{
    if (self->size && self->offset <= image->len - self->size) return (uint8_t *)image->buf + self->offset;
    PyErr_SetString(PyExc_ValueError, "the number lies outside the image");
    return NULL;
}

static uint64_t load(const Number *self, const uint8_t *at)
{
    uint64_t word = 0;
    for (Py_ssize_t i = 0; i < self->size; i++) word = word << 8 | at[self->big ? i : self->size - 1 - i];
    return word;
}

static void store(const Number *self, uint8_t *at, uint64_t word)
{
    for (Py_ssize_t i = 0; i < self->size; i++) at[self->big ? self->size - 1 - i : i] = (uint8_t)(word >> 8 * i);
}

static PyObject *decode(const Number *self, const uint8_t *at)
{
    if (self->code == '?') return PyBool_FromLong(*at & self->mask);
    uint64_t word = load(self, at);
    uint32_t half = (uint32_t)word;
    float single;
    double number;
    switch (self->code) {
    case 'b': return PyLong_FromLong((int8_t)word);
    case 'h': return PyLong_FromLong((int16_t)word);
    case 'i': return PyLong_FromLong((int32_t)word);
    case 'q': return PyLong_FromLongLong((int64_t)word);
    case 'f': memcpy(&single, &half, 4); return PyFloat_FromDouble(single);
    case 'd': memcpy(&number, &word, 8); return PyFloat_FromDouble(number);
    default: return PyLong_FromUnsignedLongLong(word);
    }
}

static PyObject *Number_decode(Number *self, PyObject *object)
{
    Py_buffer image;
    if (PyObject_GetBuffer(object, &image, PyBUF_SIMPLE) < 0) return NULL;
    const uint8_t *at = number_at(self, &image);
    PyObject *value = at ? decode(self, at) : NULL;
    PyBuffer_Release(&image);
    return value;
}

static double as_double(const Number *self, const uint8_t *at)
{
    uint64_t word = load(self, at);
    uint32_t half = (uint32_t)word;
    float single;
    double number;
    switch (self->code) {
    case 'b': return (int8_t)word;
    case 'h': return (int16_t)word;
    case 'i': return (int32_t)word;
    case 'f': memcpy(&single, &half, 4); return single;
    case 'd': memcpy(&number, &word, 8); return number;
    default: return (double)word;
    }
}

/* Writes a number, clamped to the range of its type and, for integers, rounded half to even. A float may be NaN. */
static void store_clamped(const Number *self, uint8_t *at, double value)
{
    uint64_t word = 0;
    if (value < self->minimum) value = self->minimum;
    if (value > self->maximum) value = self->maximum;
    if (self->code == 'f') {
        float single = (float)value;
        uint32_t half;
        memcpy(&half, &single, 4);
        word = half;
    } else if (self->code == 'd') {
        memcpy(&word, &value, 8);
    } else {
        int64_t whole = (int64_t)value; /* towards 0 */
        double fraction = value - (double)whole;
        if (fraction > 0.5 || (fraction == 0.5 && whole % 2)) whole++;
        if (fraction < -0.5 || (fraction == -0.5 && whole % 2)) whole--;
        word = (uint64_t)whole;
    }
    store(self, at, word);
}

#define METHOD(type, name, flags, doc) {#name, (PyCFunction)(void (*)(void))type##_##name, flags, doc}
static PyMethodDef Number_methods[] = {
    METHOD(Number, decode, METH_O, "Return the number in an image."),
    {0},
};

static PyType_Slot Number_slots[] = {
    {Py_tp_doc, "The place and the type of a number in images of a block."},
    {Py_tp_init, Number_init},
    {Py_tp_dealloc, Number_dealloc},
    {Py_tp_methods, Number_methods},
    {0, NULL},
};
static PyType_Spec Number_spec = {"shmio.injection._numbers.Number", sizeof(Number), 0, Py_TPFLAGS_DEFAULT,
                                  Number_slots};

/* ---- random numbers, as draw.py computes them for many values ------------------------------------------------------ */

#define TAU 6.283185307179586

enum { CHANCE, VALUE, ANGLE }; /* as draw.Purpose */

static uint64_t mix(uint64_t word)
{
    word += UINT64_C(0x9E3779B97F4A7C15);
    word = (word ^ word >> 30) * UINT64_C(0xBF58476D1CE4E5B9);
    word = (word ^ word >> 27) * UINT64_C(0x94D049BB133111EB);
    return word ^ word >> 31;
}

static double uniform(uint64_t key, uint64_t run, uint64_t place, uint64_t purpose)
{
    return (double)(mix(mix(mix(mix(key + run) + place) + purpose)) >> 11) * 0x1p-53;
}

static double gaussian(uint64_t key, uint64_t run, uint64_t place)
{
    return sqrt(-2 * log(1 - uniform(key, run, place, VALUE))) * cos(TAU * uniform(key, run, place, ANGLE));
}

/* Reads `count` integers modulo 2^64; returns false with an exception. */
static bool words(PyObject *const *objects, uint64_t *to, int count)
{
    for (int i = 0; i < count; i++) {
        to[i] = PyLong_AsUnsignedLongLongMask(objects[i]);
        if (to[i] == UINT64_MAX && PyErr_Occurred()) return false;
    }
    return true;
}

static PyObject *numbers_uniform(PyObject *module, PyObject *const *args, Py_ssize_t given)
{
    uint64_t word[4]; /* key, run, place, purpose */
    (void)module;
    if (given == 4) return words(args, word, 4) ? PyFloat_FromDouble(uniform(word[0], word[1], word[2], word[3])) : NULL;
    PyErr_SetString(PyExc_TypeError, "a key, a run, a place and a purpose are needed");
    return NULL;
}

/* ---- changes ------------------------------------------------------------------------------------------------------- */

enum { ADD_AMOUNT, MULTIPLY_BY, ADD_UNIFORM, ADD_GAUSSIAN }; /* as in operations.py */
enum { CHANGE_SIZE = 6 };

/* Changes one number of an image: (Number, kind, amount, key, run, first cycle of the run). Returns false with an
 * exception. */
static bool change(PyTypeObject *own, PyObject *what, const Py_buffer *image, uint64_t cycle)
{
    PyObject *fields[CHANGE_SIZE];
    uint64_t word[3]; /* key, run, cycle */
    if (!PyTuple_Check(what) || PyTuple_Size(what) != CHANGE_SIZE || Py_TYPE(PyTuple_GetItem(what, 0)) != own) {
        PyErr_SetString(PyExc_TypeError, "a change is a tuple of a Number, a kind, an amount, a key, a run and a cycle");
        return false;
    }
    for (int i = 0; i < CHANGE_SIZE; i++) fields[i] = PyTuple_GetItem(what, i);
    const Number *number = (const Number *)fields[0];
    long kind = PyLong_AsLong(fields[1]);
    if (kind == -1 && PyErr_Occurred()) return false;
    double amount = PyFloat_AsDouble(fields[2]);
    if (amount == -1.0 && PyErr_Occurred()) return false;
    if (!words(fields + 3, word, 3)) return false;
    if (!number->size || number->code == '?' || number->code == 'q' || number->code == 'Q') {
        PyErr_SetString(PyExc_TypeError, "a double cannot represent each value of this type");
        return false;
    }
    uint8_t *at = number_at(number, image);
    if (!at) return false;
    double value = as_double(number, at);
    switch (kind) {
    case ADD_AMOUNT: value += amount; break;
    case MULTIPLY_BY: value *= amount; break;
    case ADD_UNIFORM: value += (2 * uniform(word[0], word[1], cycle - word[2], VALUE) - 1) * amount; break;
    case ADD_GAUSSIAN: value += gaussian(word[0], word[1], cycle - word[2]) * amount; break;
    default: PyErr_Format(PyExc_ValueError, "there is no kind of change %ld", kind); return false;
    }
    if (isnan(value) && number->code != 'f' && number->code != 'd') {
        PyErr_SetString(PyExc_ValueError, "an integer cannot be NaN");
        return false;
    }
    store_clamped(number, at, value);
    return true;
}

static PyObject *numbers_change_all(PyObject *module, PyObject *const *args, Py_ssize_t given)
{
    PyTypeObject *own = *(PyTypeObject **)PyModule_GetState(module);
    Py_buffer image;
    uint64_t cycle;
    if (given != 3 || !PyTuple_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "an image, a tuple of changes and a cycle are needed");
        return NULL;
    }
    if (!words(args + 2, &cycle, 1) || PyObject_GetBuffer(args[0], &image, PyBUF_WRITABLE) < 0) return NULL;
    bool done = true;
    for (Py_ssize_t i = 0; done && i < PyTuple_Size(args[1]); i++)
        done = change(own, PyTuple_GetItem(args[1], i), &image, cycle);
    PyBuffer_Release(&image);
    if (!done) return NULL;
    Py_RETURN_NONE;
}

/* ---- conditions ---------------------------------------------------------------------------------------------------- */

/* Reads the values for a condition: `reads` has pairs of a source and a Number, or another object with decode();
 * `images` has the image of each source, or None. */
static PyObject *read_values(PyTypeObject *own, PyObject *reads, PyObject *images)
{
    Py_ssize_t count = PyTuple_Size(reads);
    PyObject *values = count < 0 ? NULL : PyList_New(count);
    for (Py_ssize_t i = 0; values && i < count; i++) {
        PyObject *pair = PyTuple_GetItem(reads, i), *value = NULL;
        PyObject *source = PyTuple_GetItem(pair, 0), *place = source ? PyTuple_GetItem(pair, 1) : NULL;
        PyObject *image = place ? PyDict_GetItemWithError(images, source) : NULL;
        if (image == Py_None) {
            Py_INCREF(image);
            value = image;
        } else if (image) {
            value = Py_TYPE(place) == own ? Number_decode((Number *)place, image)
                                          : PyObject_CallMethod(place, "decode", "O", image);
        } else if (!PyErr_Occurred()) {
            PyErr_SetObject(PyExc_KeyError, source);
        }
        if (!value || PyList_SetItem(values, i, value) < 0) Py_CLEAR(values);
    }
    return values;
}

#define MAX_STEPS 256

enum { PUSH, LOAD, NOT, NEG, ABS, RISING, FALLING, CHANGED, OR, AND, LT, LE, EQ, NE, GT, GE, ADD, SUB, MUL, DIV, MOD };

/* Returns the result of an edge function, or -1 with an exception. Remembers `now` as the last argument. */
static int edge(int code, PyObject *seen, PyObject *place, PyObject *now)
{
    int found = 0;
    PyObject *before = PyDict_GetItemWithError(seen, place);
    if (before) {
        int was = code == CHANGED ? 0 : PyObject_IsTrue(before), is = code == CHANGED ? 0 : PyObject_IsTrue(now);
        if (was < 0 || is < 0) return -1;
        found = code == CHANGED ? PyObject_RichCompareBool(before, now, Py_NE) : code == RISING ? !was && is : was && !is;
    } else if (PyErr_Occurred()) {
        return -1;
    }
    return found < 0 || PyDict_SetItem(seen, place, now) < 0 ? -1 : found;
}

static PyObject *apply_unary(int code, PyObject *seen, PyObject *place, PyObject *value)
{
    int truth;
    switch (code) {
    case NEG: return PyNumber_Negative(value);
    case ABS: return PyNumber_Absolute(value);
    case NOT: truth = PyObject_Not(value); break;
    default: truth = edge(code, seen, place, value);
    }
    return truth < 0 ? NULL : PyBool_FromLong(truth);
}

#define LARGE (INT64_C(1) << 50) /* as in exact.py */

static bool is_large(PyObject *integer)
{
    int overflow;
    long long value = PyLong_AsLongLongAndOverflow(integer, &overflow);
    return overflow || value >= LARGE || value <= -LARGE;
}

/* Returns whether Python's own arithmetic could round an integer of more than 50 bits. */
static bool needs_exact(int code, PyObject *left, PyObject *right)
{
    bool first = PyLong_Check(left), second = PyLong_Check(right);
    if (first && second) return code == DIV && (is_large(left) || is_large(right));
    if ((!first && !PyFloat_Check(left)) || (!second && !PyFloat_Check(right))) return true; /* a fraction */
    return (first && is_large(left)) || (second && is_large(right));
}

static PyObject *calculate_exactly(int code, PyObject *left, PyObject *right)
{
    PyObject *module = PyImport_ImportModule("shmio.injection.exact");
    PyObject *result = module ? PyObject_CallMethod(module, "calculate", "iOO", code - ADD, left, right) : NULL;
    Py_XDECREF(module);
    return result;
}

static PyObject *apply_binary(int code, PyObject *left, PyObject *right)
{
    static const int compared[] = {Py_LT, Py_LE, Py_EQ, Py_NE, Py_GT, Py_GE};
    if (code >= ADD && needs_exact(code, left, right)) return calculate_exactly(code, left, right);
    switch (code) {
    case ADD: return PyNumber_Add(left, right);
    case SUB: return PyNumber_Subtract(left, right);
    case MUL: return PyNumber_Multiply(left, right);
    case DIV: return PyNumber_TrueDivide(left, right);
    case MOD: return PyNumber_Remainder(left, right);
    case OR:
    case AND: {
        int first = PyObject_IsTrue(left), second = PyObject_IsTrue(right);
        if (first < 0 || second < 0) return NULL;
        return PyBool_FromLong(code == OR ? first || second : first && second);
    }
    default: return PyObject_RichCompare(left, right, compared[code - LT]);
    }
}

/* Runs the steps on a stack; returns the number of values that are left on it, or -1 with an exception. */
static Py_ssize_t run(const uint8_t *codes, PyObject *operands, Py_ssize_t count, PyObject *values, PyObject *seen,
                      PyObject **stack)
{
    Py_ssize_t depth = 0;
    for (Py_ssize_t i = 0; i < count; i++) {
        int code = codes[i];
        PyObject *operand = PyTuple_GetItem(operands, i), *result;
        Py_ssize_t taken = code <= LOAD ? 0 : code <= CHANGED ? 1 : 2;
        if (code > MOD || depth < taken) {
            const char *wrong = code > MOD ? "there is no such code" : "there are too few values for it";
            PyErr_Format(PyExc_ValueError, "step %zd of the condition has code %d: %s", i, code, wrong);
            goto failed;
        }
        if (code == PUSH) {
            Py_INCREF(operand);
            result = operand;
        } else if (code == LOAD) {
            Py_ssize_t place = PyLong_AsSsize_t(operand);
            result = place == -1 && PyErr_Occurred() ? NULL : PySequence_GetItem(values, place);
        } else if (taken == 1) {
            result = apply_unary(code, seen, operand, stack[depth - 1]);
        } else {
            result = apply_binary(code, stack[depth - 2], stack[depth - 1]);
        }
        if (!result) goto failed;
        while (taken-- > 0) Py_DECREF(stack[--depth]);
        stack[depth++] = result;
    }
    return depth;
failed:
    while (depth) Py_DECREF(stack[--depth]);
    return -1;
}

/* Evaluates a condition by its codes (bytes), operands (a tuple), values (a sequence) and last arguments (a dict).
 * Returns True, False, or None if a value is None or the arithmetic fails, which clears the last arguments. */
static PyObject *evaluate(PyObject *codes, PyObject *operands, PyObject *values, PyObject *seen)
{
    PyObject *stack[MAX_STEPS];
    char *steps;
    Py_ssize_t count;
    if (PyBytes_AsStringAndSize(codes, &steps, &count) < 0) return NULL;
    if (!PyTuple_Check(operands) || !PyDict_Check(seen)) {
        PyErr_SetString(PyExc_TypeError, "bytes, a tuple, a sequence and a dict are needed");
        return NULL;
    }
    int unknown = PySequence_Contains(values, Py_None);
    if (unknown < 0) return NULL;
    if (!unknown) {
        if (count == 0 || count > MAX_STEPS || PyTuple_Size(operands) != count) {
            PyErr_Format(PyExc_ValueError, "a condition has 1 to %d steps, each with one operand; not %zd with %zd",
                         MAX_STEPS, count, PyTuple_Size(operands));
            return NULL;
        }
        Py_ssize_t left = run((const uint8_t *)steps, operands, count, values, seen, stack);
        if (left > 0) {
            int truth = PyObject_IsTrue(stack[left - 1]);
            while (left) Py_DECREF(stack[--left]);
            return truth < 0 ? NULL : PyBool_FromLong(truth);
        }
        if (!PyErr_ExceptionMatches(PyExc_ArithmeticError)) return NULL;
        PyErr_Clear();
    }
    PyDict_Clear(seen);
    Py_RETURN_NONE;
}

static PyObject *numbers_evaluate(PyObject *module, PyObject *const *args, Py_ssize_t given)
{
    (void)module;
    if (given == 4) return evaluate(args[0], args[1], args[2], args[3]);
    PyErr_SetString(PyExc_TypeError, "bytes, a tuple, a sequence and a dict are needed");
    return NULL;
}

/* Evaluates a condition that also has its reads: (codes, operands, reads, seen). Returns 1 if it is true; 0 if not, or
 * if that is unknown; -1 with an exception. */
static int evaluate_one(PyTypeObject *own, PyObject *condition, PyObject *images)
{
    if (condition == Py_None) return 1;
    if (!PyTuple_Check(condition) || PyTuple_Size(condition) != 4) {
        PyErr_SetString(PyExc_TypeError, "a condition is None or a tuple of codes, operands, reads and a dict");
        return -1;
    }
    PyObject *values = read_values(own, PyTuple_GetItem(condition, 2), images);
    if (!values) return -1;
    PyObject *result = evaluate(PyTuple_GetItem(condition, 0), PyTuple_GetItem(condition, 1), values,
                                PyTuple_GetItem(condition, 3));
    Py_DECREF(values);
    Py_XDECREF(result);
    return !result ? -1 : result == Py_True;
}

static PyObject *numbers_evaluate_all(PyObject *module, PyObject *const *args, Py_ssize_t given)
{
    PyTypeObject *own = *(PyTypeObject **)PyModule_GetState(module);
    if (given != 2 || !PyTuple_Check(args[0]) || !PyDict_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "a tuple of conditions and a dict of images are needed");
        return NULL;
    }
    Py_ssize_t count = PyTuple_Size(args[0]);
    PyObject *results = PyList_New(count);
    for (Py_ssize_t i = 0; results && i < count; i++) {
        int truth = evaluate_one(own, PyTuple_GetItem(args[0], i), args[1]);
        if (truth < 0 || PyList_SetItem(results, i, PyBool_FromLong(truth)) < 0) Py_CLEAR(results);
    }
    return results;
}

/* ---- module -------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    METHOD(numbers, uniform, METH_FASTCALL, "Return the random number of a key, a run, a place and a purpose."),
    METHOD(numbers, change_all, METH_FASTCALL, "Change numbers of an image in place, one after another."),
    METHOD(numbers, evaluate, METH_FASTCALL, "Return whether a condition is true; None if that is unknown."),
    METHOD(numbers, evaluate_all, METH_FASTCALL, "Return for each condition whether it is true for images of sources."),
    {0},
};

/* The state of the module is a pointer to the type Number. */
static int module_exec(PyObject *module)
{
    PyObject **type = PyModule_GetState(module);
    *type = PyType_FromModuleAndSpec(module, &Number_spec, NULL);
    return *type ? PyModule_AddObjectRef(module, "Number", *type) : -1;
}

static int module_traverse(PyObject *module, visitproc visit, void *arg)
{
    Py_VISIT(*(PyObject **)PyModule_GetState(module));
    return 0;
}

static int module_clear(PyObject *module)
{
    Py_CLEAR(*(PyObject **)PyModule_GetState(module));
    return 0;
}

static PyModuleDef_Slot module_slots[] = {{Py_mod_exec, module_exec}, {0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "shmio.injection._numbers", "Numbers in images, and conditions over them.",
    sizeof(PyObject *), functions, module_slots, module_traverse, module_clear, NULL};

PyMODINIT_FUNC PyInit__numbers(void);
PyMODINIT_FUNC PyInit__numbers(void) { return PyModuleDef_Init(&definition); }
