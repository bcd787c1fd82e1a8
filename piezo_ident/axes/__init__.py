# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stages of several axes: several voltages, several displacements, hysteresis inside the loop.

`periodic` tests what was measured, `frequency_response`, `subspace` and `linear_fit` make a modal
model of it, `loop_model` puts softening and plays inside its loop, `loop_fit` fits all of it by
the error in free run, `explain` names what the linear model lacked.
"""
