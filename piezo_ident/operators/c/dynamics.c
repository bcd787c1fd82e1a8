// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// G in direct form, as `dynamics` computes it; every sample is stored twice, so that the past is
// always contiguous

// state
double w[{{ 2 * nb }}];
int at_w;
{% if na %}
double y[{{ 2 * na }}];
int at_y;
{% endif %}

// rest
{
    int i;
    s->at_w = 0;
    for (i = 0; i < 2 * nb; i++)
        s->w[i] = x;
}
x *= gain;
{% if na %}
{
    int i;
    s->at_y = 0;
    for (i = 0; i < 2 * na; i++)
        s->y[i] = x;
}
{% endif %}

// step
// two sums run side by side, and neither waits for the other
const double *past;
double y = 0.0, other = 0.0;
int i;

s->w[s->at_w] = s->w[s->at_w + nb] = x;
s->at_w = s->at_w + 1 < nb ? s->at_w + 1 : 0;
past = s->w + s->at_w;

for (i = nb % 2; i < nb; i += 2) {
    other += b[i] * past[i];
    y += b[i + 1] * past[i + 1];
}
if (nb % 2)
    y += b[0] * past[0];
{% if na %}
past = s->y + s->at_y;
for (i = na % 2; i < na; i += 2) {
    other -= a[i] * past[i];
    y -= a[i + 1] * past[i + 1];
}

if (na % 2)
    other -= a[0] * past[0];
y = piezo_alive(y + other);
s->y[s->at_y] = s->y[s->at_y + na] = y;
s->at_y = s->at_y + 1 < na ? s->at_y + 1 : 0;
x = y;
{% else %}
x = y + other;
{% endif %}
