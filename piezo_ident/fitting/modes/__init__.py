# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit modes that several axes share.

`periods` cuts records into periods of multisines, `frequency_response` and `subspace` start the
linear part, `linear_fit` refines it and chooses its order.  `signals` adds softening and plays,
and `loop_fit` fits everything together by the free-run error.  `creep_fit` adds creep.
"""
