# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How far the numbers hold: prediction bands, promises, deviations and weights."""
