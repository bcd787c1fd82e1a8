# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A running stage, block by block, without ROS."""
