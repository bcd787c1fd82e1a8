# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Views of a result: text at a prompt, a table and a picture in a notebook."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Showable:
    """Base of all results with a view; the front door alone imports the reports below."""

    def plot(self: Any) -> Figure:
        """Draw the result in one picture; see `piezo_ident.report.plot`."""
        import piezo_ident as pi

        return pi.report.plot(self)

    def to_json(self: Any) -> dict[str, Any]:
        """Convert the result to plain data for strict JSON; see `piezo_ident.report.to_json`."""
        import piezo_ident as pi

        return pi.report.to_json(self)

    def __repr__(self: Any) -> str:
        import piezo_ident as pi

        return pi.report.to_text(self)

    def _repr_html_(self: Any) -> str:
        import piezo_ident as pi

        return pi.report.to_html(self)
