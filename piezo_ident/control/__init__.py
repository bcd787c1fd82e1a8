# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The inverse of a model: the voltage under which a stage moves as wanted."""
