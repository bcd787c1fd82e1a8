# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One fit by free-run error.

`stretch` holds what was measured, `stage` the numbers and their derivatives, `free_run` the
Gauss-Newton loop, `equations` the normal equations block by block.
"""
