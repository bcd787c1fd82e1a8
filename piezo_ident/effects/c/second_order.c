// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// second-order sections that are added to x; `signal` is what they filter

// state
double before, s0[{{ n }}], s1[{{ n }}];

// rest
{
    int i;
    s->before = {{ signal }};
    for (i = 0; i < n; i++)
        s->s0[i] = s->s1[i] = 0.0;
}

// step
{
    const double d = {{ signal }} - s->before;
    int i;
    s->before = {{ signal }};
    for (i = 0; i < n; i++) {
        const double y = n0[i] * d + s->s0[i];
        s->s0[i] = piezo_alive(n1[i] * d - a1[i] * y + s->s1[i]);
        s->s1[i] = -a2[i] * y;
        x += y;
    }
}
