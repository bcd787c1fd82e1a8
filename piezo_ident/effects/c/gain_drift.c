// Copyright 2026 The piezo_ident authors
// SPDX-License-Identifier: Apache-2.0

// rest
x *= 1.0 + gain[0];

// step
int i = 0;
double g = gain[n - 1];
if (t < knot[n - 1]) {
    g = gain[0];
    if (t > knot[0]) {
        while (t >= knot[i + 1])
            i++;
        g = (gain[i + 1] - gain[i]) / (knot[i + 1] - knot[i]) * (t - knot[i]) + gain[i];
    }
}
x *= 1.0 + g;
