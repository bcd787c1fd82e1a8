# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The lab graph: numerics on topics, services and parameters.  Nodes hold no maths."""
