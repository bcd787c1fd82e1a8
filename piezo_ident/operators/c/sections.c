// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// G as sections, as `run_sections` computes it

// state
double z[{{ n }}][2];

// rest
{
    const double *g = sections;
    int i;
    for (i = 0; i < n; i++, g += 5) {
        const double y = x * (g[0] + g[1] + g[2]) / (1.0 + g[3] + g[4]);
        s->z[i][0] = y - g[0] * x;
        s->z[i][1] = g[2] * x - g[4] * y;
        x = y;
    }
}

// step
double (*z)[2] = s->z;
const double *g = sections;
int i;

for (i = 0; i < n; i++, g += 5) {
    const double y = g[0] * x + z[i][0];
    z[i][0] = piezo_alive((g[1] * x + z[i][1]) - g[3] * y);
    z[i][1] = piezo_alive(g[2] * x - g[4] * y);
    x = y;
}
