// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

{% macro sample() %}
double w = 0.0, bent = 0.0;
int i;
for (i = 0; i < n; i++) {
    const double f = piezo_held(s->f[i], u - r[i], u);
    s->f[i] = f;
    w += slope[i] * f;
    bent += bend[i] * f * f;
}
x += (u - bias) * w + bent;
{% endmacro %}

// state
double f[{{ n }}];

// rest
int j;
for (j = 0; j < n; j++)
    s->f[j] = piezo_held(0.0, u - r[j], u);
{
{{ sample() | indent(8, first=True) }}
        }

// step
{{ sample() }}
