// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// z^-d, as `DelayOperator` computes it

// state
double line[{{ n }}];
int at;

// rest
{
int i;
s->at = 0;
for (i = 0; i < n; i++)
    s->line[i] = x;
}

// step
s->line[s->at] = x;
s->at = s->at + 1 < n ? s->at + 1 : 0;
{% if part %}
x = (1.0 - part) * s->line[s->at + 1 < n ? s->at + 1 : 0] + part * s->line[s->at];
{% else %}
x = s->line[s->at];
{% endif %}
