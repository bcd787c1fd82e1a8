# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Process many records, each on its own and in parallel, and collect them in a table."""
