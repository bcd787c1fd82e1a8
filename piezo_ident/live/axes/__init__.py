# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Streams of several axes: joined on time, and run through the model of the stage."""
