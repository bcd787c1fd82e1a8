# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What has nothing to do with stages: errors, compiled kernels, files, configuration."""
