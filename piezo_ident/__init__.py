# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Identification of piezo-actuated nanopositioning stages."""

__version__ = '0.1.0'
