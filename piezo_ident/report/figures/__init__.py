# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures for people: what was measured, what the model makes of it, and how far they differ."""
