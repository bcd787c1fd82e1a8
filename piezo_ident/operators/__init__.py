# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's equations as operators that process a signal block by block."""
