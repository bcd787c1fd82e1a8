# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The verbs of the front door, for a stage of one axis or of several."""
