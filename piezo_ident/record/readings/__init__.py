# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Faulty readings, gaps, noise of the voltage, and doubts about a record."""
