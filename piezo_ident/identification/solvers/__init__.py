# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Solvers: ARX, output error, bounded least squares, particle swarm."""
