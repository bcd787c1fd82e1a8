#define {{ P }}_LOWEST {{ ff.lowest }}  /* V */
#define {{ P }}_HIGHEST {{ ff.highest }} /* V */
#define {{ P }}_STEP {{ ff.step }}      /* V a sample */
enum { {{ P }}_PREVIEW = {{ ff.ahead }}, {{ P }}_TAPS = {{ ff.taps | length }} };

typedef struct {
{% for link in ff.inverted.links if link.code.state %}
    {{ p }}_{{ link.tag }} {{ link.tag }};
{% else %}
    char nothing;
{% endfor %}
} {{ p }}_behind;

/* operators behind G that are inverted */
{% for what in ('rest', 'step') %}
static inline double {{ p }}_behind_{{ what }}({{ p }}_behind *s, double x, double t, const double *channel)
{
    (void)s; (void)t; (void)channel;
{% for line in ff.inverted.statements(p, what, channels) %}
    {{ line }}
{% endfor %}
    return x;
}

{% endfor %}
typedef struct {
    double k; /* number of the sample that is wanted */
    double channel[{{ [channels | length, 1] | max }}]; /* at the time of that sample */
    unsigned long clipped;
    double v, wanted;
    double x[2 * {{ P }}_TAPS];
    int at;
    {{ p }}_{{ ff.part }} front;
    {{ p }}_behind behind;
} {{ p }}_feedforward;

static inline double {{ p }}_front_at(const void *of, double u)
{
    const {{ p }}_feedforward *f = (const {{ p }}_feedforward *)of;
    {{ p }}_{{ ff.part }} front = f->front;
    return {{ p }}_{{ ff.part }}_step(&front, u, u, (f->k - {{ P }}_PREVIEW) / {{ rate }}, f->channel);
}

static inline double {{ p }}_behind_at(const void *of, double x)
{
    const {{ p }}_feedforward *f = (const {{ p }}_feedforward *)of;
    {{ p }}_behind behind = f->behind;
    return {{ p }}_behind_step(&behind, x, f->k / {{ rate }}, f->channel);
}

/* the displacement at rest, normalised */
static inline double {{ p }}_rest_at(const void *of, double u)
{
    const {{ p }}_feedforward *f = (const {{ p }}_feedforward *)of;
    {{ p }}_{{ ff.part }} front;
    {{ p }}_behind behind;
    const double x = {{ p }}_{{ ff.part }}_rest(&front, u, u, 0.0, f->channel);
    return {{ p }}_behind_rest(&behind, {{ ff.gain }} * x, 0.0, f->channel);
}

static inline double {{ p }}_feedforward_reset({{ p }}_feedforward *f, double y)
{
    const double low = ({{ P }}_LOWEST - {{ v0 }}) / {{ V }}, high = ({{ P }}_HIGHEST - {{ v0 }}) / {{ V }};
    double u, x;
    int i;
    f->k = 0.0;
    f->clipped = 0;
    f->at = 0;
    f->wanted = y - y == 0.0 ? (y - {{ y0 }}) / {{ Y }} : 0.0;
    for (i = 0; i < {{ [channels | length, 1] | max }}; i++)
        f->channel[i] = 0.0;
    u = piezo_root({{ p }}_rest_at, f, f->wanted, low, low, high);
    x = {{ ff.gain }} * {{ p }}_{{ ff.part }}_rest(&f->front, u, u, 0.0, f->channel);
    {{ p }}_behind_rest(&f->behind, x, 0.0, f->channel);
    for (i = 0; i < 2 * {{ P }}_TAPS; i++)
        f->x[i] = x;
    f->v = piezo_held({{ v0 }} + {{ V }} * u, {{ P }}_LOWEST, {{ P }}_HIGHEST);
    return f->v;
}

static inline double {{ p }}_feedforward_step({{ p }}_feedforward *f, double y)
{
    /* the oldest sample first */
    static const double taps[{{ P }}_TAPS] = {
        {{ taps | indent(8) }}
    };
    const double before = (f->v - {{ v0 }}) / {{ V }}, most = {{ P }}_STEP / {{ V }};
    const double low = fmax(({{ P }}_LOWEST - {{ v0 }}) / {{ V }}, before - most);
    const double high = fmin(({{ P }}_HIGHEST - {{ v0 }}) / {{ V }}, before + most);
    const double *past;
    double w0 = 0.0, w1 = 0.0, w2 = 0.0, w3 = 0.0, w, u, x, reached;
    int i;
    if (y - y == 0.0)
        f->wanted = (y - {{ y0 }}) / {{ Y }};
    x = f->x[f->at > 0 ? f->at - 1 : {{ P }}_TAPS - 1];
    x = piezo_root({{ p }}_behind_at, f, f->wanted, x, -{{ far }}, {{ far }});
    {{ p }}_behind_step(&f->behind, x, f->k / {{ rate }}, f->channel);
    f->x[f->at] = f->x[f->at + {{ P }}_TAPS] = x;
    f->at = f->at + 1 < {{ P }}_TAPS ? f->at + 1 : 0;
    past = f->x + f->at;
    for (i = 0; i + 3 < {{ P }}_TAPS; i += 4) {
        w0 += taps[i] * past[i];
        w1 += taps[i + 1] * past[i + 1];
        w2 += taps[i + 2] * past[i + 2];
        w3 += taps[i + 3] * past[i + 3];
    }
    for (; i < {{ P }}_TAPS; i++)
        w0 += taps[i] * past[i];
    w = (w0 + w1) + (w2 + w3);
    u = piezo_root({{ p }}_front_at, f, w, before, low, high);
    f->v = piezo_held({{ v0 }} + {{ V }} * u, {{ P }}_LOWEST, {{ P }}_HIGHEST);
    reached = {{ p }}_{{ ff.part }}_step(&f->front, u, u, (f->k - {{ P }}_PREVIEW) / {{ rate }}, f->channel);
    f->clipped += fabs(w - reached) > {{ short }};
    f->k += 1.0;
    return f->v;
}
