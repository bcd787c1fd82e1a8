# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The identifier node: captures samples, drives the excitation, and learns the model.

Its worker process imports this package without ROS.
"""
