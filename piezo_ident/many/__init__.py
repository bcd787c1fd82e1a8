# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Many records: each on its own, in parallel, with a table of them all."""
