{% set n = axes | length %}
{% set v = 'm->input, m->y' if several else 'm->input[0]' %}
/*
 * {{ p }}.h as a co-simulation of FMI 3.0.
 *
 * The voltage is held within a step; the displacement is that of the moment, for the voltage as it
 * stands.  Samples are taken at multiples of {{ period }} s from the start.
 */
#include <stdlib.h>
#include <string.h>
#include "fmi3Functions.h"
#include "{{ p }}.h"

enum { INPUTS = {{ n + channels | length }}, TIME = 0, DISPLACEMENT = 1, VOLTAGE = {{ n + 1 }} };

typedef struct {
    double start, time, input[INPUTS]{{ ', y[' ~ n ~ ']' if several }};
    double taken; /* samples */
    int runs;
    {{ p }}_state state, trial;
} Instance;

static void set_inputs(const Instance *m, {{ p }}_state *s)
{
{% if several %}
    (void)m; (void)s;
{% for member, i in members.items() %}
    s->{{ member }} = m->input[{{ i }}];
{% endfor %}
{% else %}
    int i;
    for (i = 1; i < INPUTS; i++)
        s->channel[i - 1] = m->input[i];
{% endif %}
}

static void come_to_rest({{ '' if several else 'const ' }}Instance *m, {{ p }}_state *s)
{
    {{ p }}_reset(s, {{ v }});
{% for clock in clocks %}
    s->{{ clock }} = m->start * {{ P }}_RATE;
{% endfor %}
}

static double displacement(Instance *m{{ ', fmi3ValueReference axis' if several }})
{
    if (m->runs)
        m->trial = m->state;
    else
        come_to_rest(m, &m->trial);
    set_inputs(m, &m->trial);
    {{ '' if several else 'return ' }}{{ p }}_step(&m->trial, {{ v }});
{% if several %}
    return m->y[axis];
{% endif %}
}

static void set_start(Instance *m)
{
    memset(m, 0, sizeof *m);
{% for rest in axes.values() %}
    m->input[{{ loop.index0 }}] = {{ rest }};
{% endfor %}
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance m, fmi3Boolean on, size_t n, const fmi3String categories[])
{
    (void)m; (void)on; (void)n; (void)categories;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
    const fmi3ValueReference between[], size_t n, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    Instance *m;
    (void)name; (void)resources; (void)visible; (void)logging; (void)early; (void)between;
    (void)environment; (void)log; (void)update;
    if (events || n || !token || strcmp(token, "{{ token }}"))
        return NULL;
    m = (Instance *)malloc(sizeof *m);
    if (m)
        set_start(m);
    return m;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
    fmi3Boolean visible, fmi3Boolean logging, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log)
{
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
    (void)log;
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token,
    fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)name; (void)token; (void)resources; (void)visible; (void)logging; (void)environment;
    (void)log; (void)update; (void)lock; (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance m)
{
    free(m);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance,
    fmi3Float64 tolerance, fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop)
{
    Instance *m = (Instance *)instance;
    (void)has_tolerance; (void)tolerance; (void)has_stop; (void)stop;
    m->start = m->time = start;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    Instance *m = (Instance *)instance;
    come_to_rest(m, &m->state);
    m->runs = 1;
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 point, fmi3Float64 size,
    fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *end, fmi3Boolean *early, fmi3Float64 *last)
{
    Instance *m = (Instance *)instance;
    /* rounding may put the time of a sample just before it */
    const double due = floor((point + size - m->start) * {{ P }}_RATE + 1e-6);
    (void)final;
    set_inputs(m, &m->state);
    for (; m->taken < due; m->taken += 1.0)
        {{ p }}_step(&m->state, {{ v }});
    m->time = *last = point + size;
    *event = *end = *early = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance m)
{
    (void)m;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance m)
{
    set_start((Instance *)m);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference which[], size_t n,
    fmi3Float64 values[], size_t n_values)
{
    Instance *m = (Instance *)instance;
    size_t i;
    for (i = 0; i < n && i < n_values; i++) {
        if (which[i] == TIME)
            values[i] = m->time;
        else if (which[i] {{ '< VOLTAGE' if several else '== DISPLACEMENT' }})
            values[i] = displacement(m{{ ', which[i] - DISPLACEMENT' if several }});
        else if (which[i] < VOLTAGE + INPUTS)
            values[i] = m->input[which[i] - VOLTAGE];
        else
            return fmi3Error;
    }
    return n == n_values ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference which[], size_t n,
    const fmi3Float64 values[], size_t n_values)
{
    Instance *m = (Instance *)instance;
    size_t i;
    for (i = 0; i < n && i < n_values; i++) {
        /* a value that is not finite would stay in the memory of the model for ever */
        if (which[i] < VOLTAGE || which[i] >= VOLTAGE + INPUTS || values[i] - values[i] != 0.0)
            return fmi3Error;
        m->input[which[i] - VOLTAGE] = values[i];
    }
    return n == n_values ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetFMUState(fmi3Instance m, fmi3FMUState *state)
{
    if (!*state)
        *state = malloc(sizeof(Instance));
    if (!*state)
        return fmi3Error;
    memcpy(*state, m, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance m, fmi3FMUState state)
{
    memcpy(m, state, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance m, fmi3FMUState *state)
{
    (void)m;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance m, fmi3FMUState state, size_t *size)
{
    (void)m; (void)state;
    *size = sizeof(Instance);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance m, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    (void)m;
    if (size != sizeof(Instance))
        return fmi3Error;
    memcpy(bytes, state, size);
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance m, const fmi3Byte bytes[], size_t size,
    fmi3FMUState *state)
{
    if (size != sizeof(Instance))
        return fmi3Error;
    if (fmi3GetFMUState(m, state) != fmi3OK)
        return fmi3Error;
    memcpy(*state, bytes, size);
    return fmi3OK;
}

/* functions that the standard demands and the model does not need */
#define NONE(x) (void)m; (void)which; (void)n; (void)x;
{% for type in ('Float32', 'Int8', 'UInt8', 'Int16', 'UInt16', 'Int32', 'UInt32', 'Int64', 'UInt64', 'Boolean', 'String') %}

fmi3Status fmi3Get{{ type }}(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    fmi3{{ type }} values[], size_t n_values)
{
    NONE(values)
    return n_values ? fmi3Error : fmi3OK;
}

fmi3Status fmi3Set{{ type }}(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    const fmi3{{ type }} values[], size_t n_values)
{
    NONE(values)
    return n_values ? fmi3Error : fmi3OK;
}
{% endfor %}
{% for what, const in (('Get', ''), ('Set', 'const ')) %}

fmi3Status fmi3{{ what }}Binary(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    {{ const }}size_t sizes[], {{ const }}fmi3Binary values[], size_t n_values)
{
    NONE(values)
    (void)sizes;
    return n_values ? fmi3Error : fmi3OK;
}

fmi3Status fmi3{{ what }}Clock(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    {{ const }}fmi3Clock values[])
{
    NONE(values)
    return n ? fmi3Error : fmi3OK;
}
{% endfor %}
{% for name, const in (('GetShift', ''), ('SetInterval', 'const '), ('SetShift', 'const ')) %}

fmi3Status fmi3{{ name }}Decimal(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    {{ const }}fmi3Float64 values[])
{
    NONE(values)
    return fmi3Error;
}

fmi3Status fmi3{{ name }}Fraction(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    {{ const }}fmi3UInt64 counters[], {{ const }}fmi3UInt64 resolutions[])
{
    NONE(counters)
    (void)resolutions;
    return fmi3Error;
}
{% endfor %}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
{
    NONE(intervals)
    (void)qualifiers;
    return fmi3Error;
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
{
    NONE(counters)
    (void)resolutions; (void)qualifiers;
    return fmi3Error;
}
{% for name in ('Directional', 'Adjoint') %}

fmi3Status fmi3Get{{ name }}Derivative(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[], size_t n_seed,
    fmi3Float64 values[], size_t n_values)
{
    NONE(values)
    (void)knowns; (void)n_knowns; (void)seed; (void)n_seed; (void)n_values;
    return fmi3Error;
}
{% endfor %}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance m, const fmi3ValueReference which[], size_t n,
    const fmi3Int32 orders[], fmi3Float64 values[], size_t n_values)
{
    NONE(values)
    (void)orders; (void)n_values;
    return fmi3Error;
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance m, fmi3ValueReference which, size_t *n)
{
    NONE(n)
    return fmi3Error;
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance m, fmi3ValueReference which, size_t elements[],
    fmi3ValueReference independents[], size_t indices[], fmi3DependencyKind kinds[], size_t n)
{
    NONE(elements)
    (void)independents; (void)indices; (void)kinds;
    return fmi3Error;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance m, fmi3Boolean *again, fmi3Boolean *end,
    fmi3Boolean *nominals, fmi3Boolean *states, fmi3Boolean *defined, fmi3Float64 *next)
{
    (void)m; (void)again; (void)end; (void)nominals; (void)states; (void)defined; (void)next;
    return fmi3Error;
}
{% for name in ('EnterEventMode', 'EnterStepMode', 'EnterConfigurationMode', 'ExitConfigurationMode', 'EvaluateDiscreteStates', 'EnterContinuousTimeMode') %}

fmi3Status fmi3{{ name }}(fmi3Instance m)
{
    (void)m;
    return fmi3Error;
}
{% endfor %}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance m, fmi3Boolean final, fmi3Boolean *event,
    fmi3Boolean *end)
{
    (void)m; (void)final; (void)event; (void)end;
    return fmi3Error;
}

fmi3Status fmi3SetTime(fmi3Instance m, fmi3Float64 time)
{
    (void)m; (void)time;
    return fmi3Error;
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance m, fmi3ValueReference which, fmi3Float64 time)
{
    (void)m; (void)which; (void)time;
    return fmi3Error;
}
{% for name, const in (('SetContinuousStates', 'const '), ('GetContinuousStates', ''), ('GetContinuousStateDerivatives', ''), ('GetEventIndicators', ''), ('GetNominalsOfContinuousStates', '')) %}

fmi3Status fmi3{{ name }}(fmi3Instance m, {{ const }}fmi3Float64 values[], size_t n)
{
    (void)m; (void)values; (void)n;
    return fmi3Error;
}
{% endfor %}
{% for name in ('EventIndicators', 'ContinuousStates') %}

fmi3Status fmi3GetNumberOf{{ name }}(fmi3Instance m, size_t *n)
{
    (void)m; (void)n;
    return fmi3Error;
}
{% endfor %}
