# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Draws the lab graph.

    .venv/bin/python docs/images/draw_graph.py docs/images/graph.svg
"""

from __future__ import annotations

from pathlib import Path
import sys
import textwrap

import matplotlib

matplotlib.use('svg')

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from piezo_ident.nodes.parameters import NODES

#: topic, publishers, subscribers: as in docs/graph.md
TOPICS = (
    ('voltage', ('excitation', 'player', 'feedforward'), ('stage', 'identifier', 'model')),
    ('displacement', ('stage', 'player'), ('identifier', 'model', 'feedforward')),
    ('applied_voltage', ('stage',), ('identifier',)),
    ('reference', (), ('feedforward',)),
    ('tracking_error', ('feedforward',), ()),
    ('prediction', ('model',), ()),
    ('residual', ('model',), ()),
    ('estimate', ('model',), ()),
    ('corrections', ('model',), ()),
    ('preview', ('model',), ()),
    ('model', ('identifier',), ('model', 'feedforward')),
    ('report', ('identifier',), ()),
)
#: where each node stands, and what it is beside its name
PLACES = {
    'excitation': (1.0, 5.0, 'plays programs'),
    'stage': (1.0, 3.2, 'simulated, or your DAQ driver'),
    'player': (1.0, 1.4, 'replays a bag'),
    'identifier': (6.2, 5.0, 'captures, learns the model'),
    'model': (6.2, 2.6, 'predicts block by block'),
    'recorder': (6.2, 0.9, 'writes topics to a bag'),
    'feedforward': (6.2, 6.8, 'follows a reference'),
}
#: where each topic stands; the topic `model` lies between the two nodes
SPOTS = {
    'voltage': (3.6, 4.7),
    'displacement': (3.6, 3.4),
    'applied_voltage': (3.6, 2.6),
    'model': (6.2, 3.8),
    'report': (9.0, 4.8),
    'reference': (3.6, 6.8),
    'tracking_error': (9.0, 6.8),
    'prediction': (9.0, 3.4),
    'residual': (9.0, 2.95),
    'estimate': (9.0, 2.5),
    'corrections': (9.0, 2.0),
    'preview': (9.0, 1.55),
}
NODE, TOPIC = '#2b5c8a', '#555555'
WIDTH, HEIGHT = 1.9, 0.72
#: lines that pass another node: from, to, and their bend
BENDS = {('feedforward', 'model'): ((6.56, 3.9), (7.15, 6.6), 'arc3,rad=0.5')}
#: what is recorded lies in these frames: left, bottom, width, height, and a side to leave by
FRAMES = ((2.72, 2.25, 1.76, 2.8, (3.9, 2.25)), (8.25, 2.28, 1.5, 1.35, (8.35, 2.28)))


def box(ax: Axes, x: float, y: float, name: str, about: str) -> None:
    """Draw a node."""
    corner = (x - WIDTH / 2, y - HEIGHT / 2)
    style = 'round,pad=0,rounding_size=0.12'
    ax.add_patch(
        FancyBboxPatch(corner, WIDTH, HEIGHT, style, fc='#eaf1f8', ec=NODE, lw=1.4, zorder=3)
    )
    ax.text(x, y + 0.1, name, ha='center', va='center', weight='bold', color=NODE, zorder=4)
    ax.text(x, y - 0.19, about, ha='center', va='center', fontsize=7, color=NODE, zorder=4)


def spot(ax: Axes, x: float, y: float, name: str) -> None:
    """Draw a topic."""
    ax.text(
        x,
        y,
        name,
        ha='center',
        va='center',
        family='monospace',
        fontsize=9,
        zorder=4,
        bbox={'boxstyle': 'square,pad=0.35', 'fc': 'white', 'ec': TOPIC, 'lw': 0.9},
    )


def edge(node: str, topic: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ends of the line between a node and a topic."""
    (x, y, _), (u, v) = PLACES[node], SPOTS[topic]
    half = 0.1 + 0.047 * len(topic)
    if abs(u - x) < 0.1:
        sign = 1.0 if v > y else -1.0
        return (x, y + sign * HEIGHT / 2), (u, v - sign * 0.2)
    sign = 1.0 if u > x else -1.0
    return (x + sign * WIDTH / 2, y + 0.3 * (v > y) - 0.15), (u - sign * half, v)


def arrow(ax: Axes, begin: tuple[float, float], end: tuple[float, float], **how: object) -> None:
    """Draw an arrow."""
    style = {'arrowstyle': '-|>', 'mutation_scale': 9, 'lw': 1.0, 'color': TOPIC, 'zorder': 2}
    ax.add_patch(FancyArrowPatch(begin, end, shrinkA=0, shrinkB=0, **{**style, **how}))


def draw() -> Figure:
    """Return the picture."""
    figure = Figure(figsize=(10.4, 7.4), layout='constrained')
    ax = figure.add_subplot()
    ax.set(xlim=(-0.15, 10.1), ylim=(-0.4, 7.4), aspect='equal')
    ax.axis('off')
    for name in NODES:
        box(ax, *PLACES[name][:2], name, PLACES[name][2])
    for topic, publishers, subscribers in TOPICS:
        spot(ax, *SPOTS[topic], topic)
        for node in publishers:
            begin, end = edge(node, topic)
            # a replay takes the place of what was measured
            arrow(ax, begin, end, ls='--' if node == 'player' else '-')
        for node in subscribers:
            begin, end = edge(node, topic)
            end, begin, bend = BENDS.get((node, topic), (end, begin, 'arc3'))
            arrow(ax, end, begin, connectionstyle=bend)
    x, y, _ = PLACES['recorder']
    for left, bottom, width, height, leave in FRAMES:
        style = 'round,pad=0,rounding_size=0.1'
        ax.add_patch(
            FancyBboxPatch(
                (left, bottom), width, height, style, fc='#f6f6f3', ec='#d8d8d0', zorder=0
            )
        )
        side = 1.0 if left > x else -1.0
        arrow(ax, leave, (x + side * WIDTH / 2, y), ls=':', color=NODE)
    x, y, _ = PLACES['identifier']
    arrow(
        ax,
        (x - 0.5, y + HEIGHT / 2),
        (PLACES['excitation'][0] + 0.3, PLACES['excitation'][1] + HEIGHT / 2),
        connectionstyle='arc3,rad=0.13',
        color=NODE,
    )
    ax.text(3.6, 5.8, 'sets program, calls ~/start', ha='center', fontsize=8, color=NODE)
    u, v = SPOTS['reference']
    told = 'from you, or from an excitation\nwith quantity: reference'
    ax.text(1.6, v, told, ha='center', va='center', fontsize=8, color=TOPIC)
    arrow(ax, (2.6, v), (u - 0.53, v))
    u, v = SPOTS['preview']
    ax.text(u, 1.05, 'PlotJuggler, rqt_plot,\nFoxglove', ha='center', fontsize=8, color=TOPIC)
    arrow(ax, (u, v - 0.2), (u, 1.4))
    recorded = next(d.default for d in NODES['recorder'] if d.name == 'topics')
    note = (
        'Every node publishes its ~/status, and its /diagnostics once a second.  '
        f'Recorded by default: {", ".join(recorded)}.'
    )
    note = textwrap.fill(note, 165)
    ax.text(-0.05, 0.05, note, fontsize=7.5, color=TOPIC, va='top')
    return figure


def main() -> None:
    """Write the file named on the command line."""
    # text stays text, and the same picture is the same file
    matplotlib.rcParams.update({'svg.fonttype': 'none', 'svg.hashsalt': 'piezo_ident'})
    draw().savefig(Path(sys.argv[1]), metadata={'Date': None})


if __name__ == '__main__':
    main()
