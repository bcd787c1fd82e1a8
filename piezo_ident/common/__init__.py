# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Errors, compiled kernels, files and configuration, of use without any stage."""
