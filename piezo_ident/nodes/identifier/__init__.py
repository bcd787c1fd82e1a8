# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identifier node: captures samples, drives the excitation, and identifies the model.

The worker process of the node imports this package without ROS.
"""
