# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit a stage by free-run error.

`stretch` holds the measured motion, `stage` the parameters and their derivatives, `free_run` the
fit, `damped` the Gauss-Newton loop, `equations` the normal equations block by block.  `adaptation`
fits a stage that runs, sample by sample, with the loops of `adaptation_kernel`.
"""
