# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One comparison of candidates, on blocks and on kinds of motion that were held out."""
