# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One comparison of candidates on held-out blocks and kinds of motion, and judged runs."""
