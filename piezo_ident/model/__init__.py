# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Model of a stage: its file, its free run on a record, and the simulated stage."""
