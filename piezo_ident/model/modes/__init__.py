# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Modes that several axes share, with hysteresis inside their loop."""
