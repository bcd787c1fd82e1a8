// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// H, as `hysteresis`, `wide_hysteresis` and `relaxing` compute it

{% macro lags() %}
// `lags` becomes the sum of the lags after the voltage went to `to`
{
    const double length = fabs(to - s->last);
    const double *const line = lines + (to > s->last ? 3 * n : 0);
    double left = 0.0;
    int j;

    lags = 0.0;
    for (j = 0; j < n; j++) {
        if (length > 0.0) {
            const double e0 = line[j], e1 = line[n + j], e2 = line[2 * n + j];
            const double now = e0 + to * (e1 + to * (e2 + to * d3[j]));
            const double was = e0 + s->last * (e1 + s->last * (e2 + s->last * d3[j]));
            left = j > 0 && rate[j] == 2.0 * rate[j - 1] ? left * left : exp(-rate[j] * length);
            s->z[j] = now + (s->z[j] - was) * left;
        }
        lags += s->z[j] - to * (d1[j] + to * (d2[j] + to * d3[j]));
    }
    s->last = to;
}
{% endmacro %}
{% macro sample() %}
{% if has_plays %}
int i;
double w = 0.0;
for (i = 0; i < m; i++) {
    s->f[i] = piezo_held(s->f[i], x - r[i], x);
    w += q[i] * s->f[i];
}
{% else %}
double w = 0.0;
{% endif %}
{% if has_curves %}
for (i = 0; i < m; i++)
    w += kappa[i] * (x - low) * (s->f[i] - low)
        + piezo_curve(c1[i], c2[i], c3[i], width[i], s->f[i] - low);
{% endif %}
{% if has_lags %}
{
const double to = x;
double lags;
{{ lags() }}
w += lags;
}
{% endif %}
x = w + ((p1 * x + p0) * x + p2) * x;
{% endmacro %}

// state
{% if has_plays %}
double f[{{ m }}];
{% endif %}
{% if has_lags %}
double z[{{ n }}];
double last;
{% endif %}

// rest
{% if has_plays %}
{
    int i;
    for (i = 0; i < m; i++)
        s->f[i] = piezo_held(0.0, x - r[i], x);
}
{% endif %}
{% if has_lags %}
{
    const double way[5] = {high, low, high, low, x};
    double lags;
    int i;

    for (i = 0; i < n; i++)
        s->z[i] = low * (d1[i] + low * (d2[i] + low * d3[i]));
    s->last = low;
    for (i = 0; i < 5; i++) {
        const double to = way[i];
{{ lags() }}
    }
    (void)lags;
}
{% endif %}
// at rest, H has processed its voltage once
{
{{ sample() }}
}

// step
{{ sample() }}
