# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How a result shows itself: text at a prompt, a table and a picture in a notebook."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Showable:
    """Base of what is shown through the front door, which alone may look down to the reports."""

    def plot(self: Any) -> Figure:
        """Draw the picture that tells most of it; see `piezo_ident.report.plot`."""
        import piezo_ident as pi

        return pi.report.plot(self)

    def to_json(self: Any) -> dict[str, Any]:
        """Convert it to plain data for strict JSON; see `piezo_ident.report.to_json`."""
        import piezo_ident as pi

        return pi.report.to_json(self)

    def __repr__(self: Any) -> str:
        import piezo_ident as pi

        return pi.report.to_text(self)

    def _repr_html_(self: Any) -> str:
        import piezo_ident as pi

        return pi.report.to_html(self)
