# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Make input signals for a stage, and programs of such signals."""
