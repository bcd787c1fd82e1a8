# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Prediction bands, promises, deviations of parameters, and weights of causes."""
