# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Measured voltage and displacement over time, from any file or stream."""
