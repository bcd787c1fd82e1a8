# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Models for other programs: a C header with prediction and feed-forward."""
