# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Noise floor, lines, dependence and faults of the data in the residual of a model."""
