# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""From records to a model: the three steps of the paper, or one fit of all parameters."""
