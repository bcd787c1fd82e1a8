# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Model of a stage: its file, free run, observer, several axes, and the simulated stage."""
