// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// state
double wide[{{ m }}], still[{{ m }}], last, speed;

// rest
int i;
for (i = 0; i < m; i++)
    s->wide[i] = s->still[i] = piezo_held(0.0, u - r[i], u);
s->last = u;
s->speed = 0.0;

// step
double power, w = 0.0;
int i;
s->speed = piezo_alive(pole * s->speed + (1.0 - pole) * (u - s->last) * per_second);
s->last = u;
power = fabs(s->speed);
{# terms with a zero coefficient are left out -#}
{% set levelled = 'power /= 1.0 + levelling * power; ' if levelling > 0.0 else '' %}
{% set raised = 'power = pow(power, exponent);' if exponent != 1.0 else '' %}
{{ levelled }}{{ raised }}
{% set curve = 'piezo_curve(c1[i], c2[i], c3[i], width[i], %s - low)' %}
for (i = 0; i < m; i++) {
    const double g = piezo_held(s->still[i], u - r[i], u);
    const double half = {{ 'r[i] * (1.0 + stretch * power)' if stretch else 'r[i]' }}
        {{- ' + gain * power' if gain }};
    const double bottom = u - (half > 0.0 ? half : 0.0);
    const double top = {{ 'u + r[i] * (lead_stretch * power)' if lead_stretch else 'u' }}
        {{- ' + lead * power' if lead }};
    const double f = piezo_held(s->wide[i], bottom, top < bottom ? bottom : top);
    s->still[i] = g;
    s->wide[i] = f;
    w += {{ '(q[i] + kappa[i] * (u - low))' if has_curves else 'q[i]' }} * (f - g)
        {{- ' + %s - %s' % (curve % 'f', curve % 'g') if has_curves }};
}
x += w;
