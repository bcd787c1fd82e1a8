/*
{% for line in title %}
 * {{ line }}
{% endfor %}
 *
 * Made by piezo_ident {{ version }}.  C99, float64, <math.h> alone, no malloc; volts and metres,
 * {{ hertz }} samples a second.  Compile without -ffast-math.
 *
 * {{ axes | length }} axes share modes: v is {{ voltages }}, y is {{ axes | join(', ') }}.
 *
 *     {{ p }}_state s;
 *     {{ p }}_reset(&s, v, y);      at rest under v, after {{ settling }} samples of it; y is where
 *     {{ p }}_step(&s, v, y);       the next sample
 *
 * There is no feed-forward:
 * a motion of shared modes is inverted as a whole, by piezo_ident invert
 */
#ifndef {{ P }}_H
#define {{ P }}_H

#include <math.h>

{{ helpers }}

#define {{ P }}_RATE {{ rate }} /* samples a second */

typedef struct {
    double x[{{ order }}]; /* modes */
{% if plays %}
    double memory[{{ signals }}][{{ thresholds }}]; /* outputs of the plays */
{% endif %}
{% if creep %}
    double creep[{{ axes | length }}][{{ creep }}];
{% endif %}
    double level; /* squared level of the signals that soften */
} {{ p }}_state;

static inline void {{ p }}_step({{ p }}_state *s, const double v[{{ axes | length }}], double y[{{ axes | length }}])
{
{% for line in constants %}
    {{ line }}
{% endfor %}
    double u[{{ axes | length }}], next[{{ order }}];
{% if signals %}
    double p[{{ signals }}];
{% endif %}
{% if levels %}
    const double softening = piezo_held(sqrt(s->level), {{ low }}, {{ high }}) - 1.0;
    double squares = 0.0;
{% endif %}
    int i, j{% if plays or creep %}, k{% endif %};
{% for column in columns %}
    u[{{ loop.index0 }}] = v[{{ column }}] - v0[{{ loop.index0 }}];
{% endfor %}
{% if creep %}
    for (i = 0; i < {{ axes | length }}; i++) {
        double crept = 0.0;
        for (k = 0; k < {{ creep }}; k++) {
            s->creep[i][k] = piezo_alive(s->creep[i][k] + share[k] * (u[i] - s->creep[i][k]));
            crept += creep[i][k] * s->creep[i][k];
        }
        u[i] += crept;
    }
{% endif %}
{% if signals %}
    for (j = 0; j < {{ signals }}; j++) {
        double z = 0.0;
        for (i = 0; i < {{ order }}; i++)
            z += f[j][i] * s->x[i];
        for (i = 0; i < {{ axes | length }}; i++)
            z += g[j][i] * u[i];
{% if levels %}
        if (j < {{ levels }}) {
            squares += z * z;
            p[j] = z * softening;
            continue;
        }
{% endif %}
        p[j] = 0.0;
{% if plays %}
        for (k = 0; k < {{ thresholds }}; k++) {
            if (z - s->memory[j][k] > r[k])
                s->memory[j][k] = z - r[k];
            else if (z - s->memory[j][k] < -r[k])
                s->memory[j][k] = z + r[k];
            p[j] += mu[j][k] * s->memory[j][k];
        }
{% endif %}
    }
{% endif %}
{% for column in columns %}
    {
        double out = 0.0;
        for (i = 0; i < {{ order }}; i++)
            out += c[{{ loop.index0 }}][i] * s->x[i];
        for (i = 0; i < {{ axes | length }}; i++)
            out += d[{{ loop.index0 }}][i] * u[i];
{% if signals %}
        for (i = 0; i < {{ signals }}; i++)
            out += h[{{ loop.index0 }}][i] * p[i];
{% endif %}
        y[{{ column }}] = out + y0[{{ loop.index0 }}];
    }
{% endfor %}
{% if levels %}
    s->level = piezo_alive({{ kappa }} * s->level + {{ rest }} * squares / {{ levels }}.0);
{% endif %}
    for (i = 0; i < {{ order }}; i += 2) {
        const double *a = blocks[i / 2];
        next[i] = a[0] * s->x[i] + a[1] * s->x[i + 1];
        next[i + 1] = a[2] * s->x[i] + a[3] * s->x[i + 1];
    }
    for (i = 0; i < {{ order }}; i++) {
        for (j = 0; j < {{ axes | length }}; j++)
            next[i] += b[i][j] * u[j];
{% if signals %}
        for (j = 0; j < {{ signals }}; j++)
            next[i] += e[i][j] * p[j];
{% endif %}
        s->x[i] = piezo_alive(next[i]);
    }
}

static inline void {{ p }}_reset({{ p }}_state *s, const double v[{{ axes | length }}], double y[{{ axes | length }}])
{
    {{ p }}_state settled;
    int i{% if plays or creep %}, k{% endif %};
{% if creep %}
{% for column in columns %}
    for (k = 0; k < {{ creep }}; k++)
        s->creep[{{ loop.index0 }}][k] = v[{{ column }}] - {{ middle[loop.index0] }};
{% endfor %}
{% endif %}
    s->level = 1.0;
    for (i = 0; i < {{ order }}; i++)
        s->x[i] = 0.0;
{% if plays %}
    for (i = 0; i < {{ signals }}; i++)
        for (k = 0; k < {{ thresholds }}; k++)
            s->memory[i][k] = 0.0;
{% endif %}
    for (i = 0; i < {{ settling }}; i++)
        {{ p }}_step(s, v, y);
    settled = *s;
    {{ p }}_step(&settled, v, y);
}

#endif
