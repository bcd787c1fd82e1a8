# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Invert the paths between axes, and modes that the axes share: offline and block by block."""
