# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records in rosbag2 bags: reading, writing, and recovery of unfinished bags."""
