# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What was measured: voltage and displacement over time, from any file or stream."""
