// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

{% set size = 'fabs(half)' if power == 1.0 else 'pow(fabs(half), power)' %}
{% macro slipped() %}
    // the slip of element i of a spring at q, as in `_slipped`
    double way, half = s->slip[i];
    play[i] = piezo_held(s->play[i], q - threshold[i], q + threshold[i]);
    way = play[i] - s->play[i];
    if (gamma[i] == 0.0)
        half += way;
    else
        for (m = 0; m < 2; m++) {
            const double side = way > 0.0 ? 1.0 : -1.0;
            const double bent = gamma[i] * (skew[i] + (half > 0.0 ? side : -side));
            half = s->slip[i] + (m ? 1.0 : 0.5) * way * (1.0 - bent * {{ size }});
        }
    slip[i] = half;
    force += stiffness[i] * half;
{% endmacro %}

// state
double w1, w2, l[2], d[2], h, rest_x, rest_q, rest_h, play[{{ n }}], slip[{{ n }}];

// rest
{
    double q = x / (1.0 + elastic);
    int i;
    for (i = 0; i < {{ bends }}; i++) {
        const double left = x - q * (1.0 + elastic + q * (square + q * cubic));
        q += left / (1.0 + elastic + q * (2.0 * square + q * (3.0 * cubic)));
    }
    for (i = 0; i < n; i++) {
        s->play[i] = q;
        s->slip[i] = 0.0;
    }
    s->w1 = s->w2 = s->h = 0.0;
    s->l[0] = s->l[1] = s->d[0] = s->d[1] = 0.0;
    s->rest_x = x;
    s->rest_q = q;
    s->rest_h = q * (elastic + q * (square + q * cubic));
    x -= s->rest_h;
}

// step
// one sample of `run_loop`
{
    const double w0 = x - s->rest_x;
    const double slope = 0.5 * (3.0 * w0 - 4.0 * s->w1 + s->w2);
    const double bend = 0.5 * (w0 - 2.0 * s->w1 + s->w2);
    double play[{{ n }}], slip[{{ n }}], begin = s->w1;
    int i, j, k, m;
    for (j = 0; j < count; j++) {
        const double tau = (j + 1.0) / count - 1.0;
        const double end = w0 + tau * (slope + tau * bend);
        const double *const l = s->l, *const d = s->d;
        const double m0 = to_q[0] * l[0] + to_q[1] * l[1] + to_q[2] * begin + to_q[3] * end;
        const double m1 = to_p[0] * l[0] + to_p[1] * l[1] + to_p[2] * begin + to_p[3] * end;
        const double e0 = to_q[0] * d[0] + to_q[1] * d[1] - to_q[2] * s->h;
        const double e1 = to_p[0] * d[0] + to_p[1] * d[1] - to_p[2] * s->h;
        double force = s->h;
        for (k = 0; k < {{ repeated }}; k++) {
            const double q = s->rest_q + (m0 + e0 - to_q[3] * force);
            const double p = m1 + e1 - to_p[3] * force;
            force = q * (elastic + q * (square + q * cubic)) + viscous * p;
            for (i = 0; i < n; i++) {
{{ slipped() }}
            }
            force -= s->rest_h;
        }
        s->l[0] = piezo_alive(m0);
        s->l[1] = piezo_alive(m1);
        s->d[0] = piezo_alive(e0 - to_q[3] * force);
        s->d[1] = piezo_alive(e1 - to_p[3] * force);
        s->h = force;
        begin = end;
        for (i = 0; i < n; i++) {
            s->play[i] = play[i];
            s->slip[i] = slip[i];
        }
    }
    s->w2 = s->w1;
    s->w1 = w0;
    x -= s->rest_h + s->h;
}
