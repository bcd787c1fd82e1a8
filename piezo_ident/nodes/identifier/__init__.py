# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identifier node, the jobs of its worker process, and its client of the excitation.

The worker process imports this package without ROS.
"""
