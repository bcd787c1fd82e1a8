# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What drives the stage: signals, and programs made of them."""
