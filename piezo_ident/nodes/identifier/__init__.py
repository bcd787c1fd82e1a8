# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The identifier node: captures samples, drives the excitation, and learns the model."""


def main(argv: list[str] | None = None) -> int:
    """Run the node; its worker process imports this package without ROS."""
    from piezo_ident.nodes.identifier import node

    return node.main(argv)
