# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Solvers: particle swarm, bounded least squares, output error."""
