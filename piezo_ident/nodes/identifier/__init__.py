# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The identifier node.  Its worker process imports this package without ROS."""
