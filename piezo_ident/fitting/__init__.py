# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit a stage by free-run error.

`stretch` holds the measured motion, `stage` the parameters and their derivatives, `free_run` the
fit, `damped` its steps, `equations` its blocks, `jackknife` the fit without each block.  For a
stage that runs, `adaptation` learns changes, and `attribution` names the part that changed.
"""
