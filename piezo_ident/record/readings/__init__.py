# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Judgement of the readings of a record: faults, gaps, noise of the voltage, and doubts."""
