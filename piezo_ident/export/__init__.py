# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Export models to other programs: as a C header with prediction and feed-forward, or an FMU."""
