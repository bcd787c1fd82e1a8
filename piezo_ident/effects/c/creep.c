// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// state
double h[{{ n }}];

// rest
int i;
for (i = 0; i < n; i++)
    s->h[i] = x;
x *= rest;

// step
double w = 0.0;
int i;
for (i = 0; i < n; i++) {
    s->h[i] = piezo_alive(s->h[i] + share[i] * (x - s->h[i]));
    w += gain[i] * s->h[i];
}
x += w;
