/*
{% for line in title %}
 * {{ line }}
{% endfor %}
 *
 * Made by piezo_ident {{ version }}.  C99, float64, <math.h> alone, no malloc; volts and metres,
 * {{ hertz }} samples a second.  Compile without -ffast-math.
 *
 *     {{ p }}_state s;
 *     {{ p }}_reset(&s, v);             at rest under v; returns the displacement there
 *     y = {{ p }}_step(&s, v);          the next sample
{% if channels %}
 *
 * Before each step the caller sets what effects of the model depend on:
{% for c in channel_names %}
 *     s.channel[{{ loop.index0 }}]  {{ c }}
{% endfor %}
{% endif %}
 *
{% if ff %}
 *     {{ p }}_feedforward f;
 *     v = {{ p }}_feedforward_reset(&f, y);   at rest at y; returns the voltage there
 *     v = {{ p }}_feedforward_step(&f, y);    y is wanted {{ ff.ahead }} samples from now ({{ P }}_PREVIEW)
 *
{% for line in ff.says %}
 * {{ line }}
{% endfor %}
{% else %}
 * There is no feed-forward:
{% for line in why %}
 * {{ line }}
{% endfor %}
{% endif %}
 */
#ifndef {{ P }}_H
#define {{ P }}_H

#include <math.h>

{{ helpers }}

{% for link in links %}
{% if link.code.step %}
/* {{ link.name }} */
{% if link.code.state %}
typedef struct {
{% for member in link.members %}
    {{ member }}
{% endfor %}
} {{ p }}_{{ link.tag }};

{% endif %}
{% for what in ('rest', 'step') if link.code[what] %}
static inline double {{ p }}_{{ link.tag }}_{{ what }}({% if link.code.state %}{{ p }}_{{ link.tag }} *s, {% endif %}
double x{% for name in link.signals_in(link.code[what]) %}, double {{ name }}{% endfor %})
{
{{ link.body(link.code[what]) | indent(4, first=True) }}
    return x;
}

{% endfor %}
{% endif %}
{% endfor %}
{% for name, part in parts.items() %}
typedef struct {
{% for link in part.links if link.code.state %}
    {{ p }}_{{ link.tag }} {{ link.tag }};
{% else %}
    char nothing;
{% endfor %}
} {{ p }}_{{ name }};

{% for what in ('rest', 'step') %}
static inline double {{ p }}_{{ name }}_{{ what }}({{ p }}_{{ name }} *s, double x, double v, double t,
    const double *channel)
{
{% if part.is_wrapped %}
    double u;
{% endif %}
    (void)s; (void)v; (void)t; (void)channel;
{% for line in part.statements(p, what, channels) %}
    {{ line }}
{% endfor %}
    return x;
}

{% endfor %}
{% endfor %}
#define {{ P }}_RATE {{ rate }} /* samples a second */

typedef struct {
    double k; /* samples since the clock started; effects that time drives follow it */
    double channel[{{ [channels | length, 1] | max }}];
    {{ p }}_front front;
    {{ p }}_linear linear;
    {{ p }}_back back;
} {{ p }}_state;

static inline double {{ p }}_reset({{ p }}_state *s, double v)
{
    const double u = (v - {{ v0 }}) / {{ V }};
    double x;
    int i;
    s->k = 0.0;
    for (i = 0; i < {{ [channels | length, 1] | max }}; i++)
        s->channel[i] = 0.0;
    x = {{ p }}_front_rest(&s->front, u, u, 0.0, s->channel);
    x = {{ p }}_linear_rest(&s->linear, x, u, 0.0, s->channel);
    x = {{ p }}_back_rest(&s->back, x, u, 0.0, s->channel);
    return {{ y0 }} + {{ Y }} * x;
}

static inline double {{ p }}_step({{ p }}_state *s, double v)
{
    const double u = (v - {{ v0 }}) / {{ V }};
    const double t = s->k / {{ rate }};
    double x = {{ p }}_front_step(&s->front, u, u, t, s->channel);
    x = {{ p }}_linear_step(&s->linear, x, u, t, s->channel);
    x = {{ p }}_back_step(&s->back, x, u, t, s->channel);
    s->k += 1.0;
    return {{ y0 }} + {{ Y }} * x;
}
{% if ff %}

{{ feedforward }}
{% endif %}

#endif
