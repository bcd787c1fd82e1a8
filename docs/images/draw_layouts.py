# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Draws the plots of both layouts from a recorded bag, as the two programs would fill them.

    .venv/bin/python docs/images/draw_layouts.py recording docs/images
"""

from __future__ import annotations

from collections import defaultdict
import json
from pathlib import Path
import sys
from typing import Any
import xml.etree.ElementTree as ET

import matplotlib

matplotlib.use('agg')

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.record.bags.read import opened_bag, typestore

CONFIG = Path(__file__).resolve().parents[2] / 'config'
#: curves of a plot: title, and name, x (None: time), y and colour of each
Plot = tuple[str, list[tuple[str, str | None, str, str]]]


def series(bag: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return time [s] and values of each series of `/preview`, under PlotJuggler's names."""
    found: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with opened_bag(bag) as opened:
        chosen = [c for c in opened.connections if c.topic == '/preview']
        for connection, stamp, raw in opened.messages(chosen):
            message: Any = typestore().deserialize_cdr(raw, connection.msgtype)
            for k, (name, value) in enumerate(zip(message.name, message.position, strict=True)):
                point = (stamp * 1e-9, value)
                found[f'/preview/{name}/position'].append(point)
                found[f'/preview.position[{k}]'].append(point)
    start = min(points[0][0] for points in found.values())
    arrays = {name: np.array(points).T for name, points in found.items()}
    return {name: (t - start, y) for name, (t, y) in arrays.items()}


def of_plotjuggler() -> list[Plot]:
    """Return the plots of the first two tabs."""
    plots = []
    for tab in list(ET.parse(CONFIG / 'plotjuggler.xml').iter('Tab'))[:2]:
        for area in tab.iter('DockArea'):
            curves = [
                (c.get('name', ''), c.get('curve_x'), c.get('curve_y') or c.get('name', ''))
                for c in area.iter('curve')
            ]
            colors = [c.get('color', '') for c in area.iter('curve')]
            plots.append(
                (area.get('name', ''), [(*c, k) for c, k in zip(curves, colors, strict=True)])
            )
    return plots


def of_foxglove() -> list[Plot]:
    """Return the plot panels."""
    panels = json.loads((CONFIG / 'foxglove.json').read_text(encoding='utf-8'))['configById']
    return [
        (
            panel['foxglovePanelTitle'],
            [
                (p['label'], panel.get('xAxisPath', {}).get('value'), p['value'], p['color'])
                for p in panel['paths']
            ],
        )
        for name, panel in panels.items()
        if name.startswith('Plot!')
    ]


def draw(plots: list[Plot], data: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    """Draw plots below each other, two beside each other where they are over the voltage."""
    figure = Figure(figsize=(9.0, 1.2 + 2.1 * (len(plots) - 1)), layout='constrained')
    grid = figure.add_gridspec(len(plots) - 1, 2, height_ratios=[1.7] + [1] * (len(plots) - 2))
    for k, (title, curves) in enumerate(plots):
        axes = figure.add_subplot(grid[0, k] if k < 2 else grid[k - 1, :])
        for name, x, y, color in curves:
            t, values = data[y]
            across = t if x is None else data[x][1]
            axes.plot(across, values, color=color, lw=0.8, label=name.split('/preview/')[-1])
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=8)
        axes.legend(fontsize=7, loc='upper left', framealpha=0.9)
    figure.savefig(path, dpi=110)


if __name__ == '__main__':
    points, folder = series(Path(sys.argv[1])), Path(sys.argv[2])
    draw(of_plotjuggler(), points, folder / 'plotjuggler.png')
    draw(of_foxglove(), points, folder / 'foxglove.png')
