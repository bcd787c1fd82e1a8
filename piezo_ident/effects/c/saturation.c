// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

{% macro limited() %}
{% if not knee %}
{% if has_low %}
x = x < low ? low : x;
{% endif %}
{% if has_high %}
x = x > high ? high : x;
{% endif %}
{% elif has_low or has_high %}
double y = x, z;
// as in `_soften`, the upper end first
{% if has_high %}
z = (x - high) / knee;
if (z > knees)
    y = high;
else if (z > -knees)
    y = x - knee * (z < 0.0 ? log1p(exp(z)) : z + log1p(exp(-z)));
{% endif %}
{% if has_low %}
z = (low - x) / knee;
if (z > knees)
    y += low - x;
else if (z > -knees)
    y += knee * (z < 0.0 ? log1p(exp(z)) : z + log1p(exp(-z)));
{% endif %}
x = y;
{% endif %}
{% endmacro %}

// rest
{{ limited() }}

// step
{{ limited() }}
