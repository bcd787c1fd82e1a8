# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a node is given when it starts and cannot take: an end with one line, or a warning."""

import signal

from graph import Graph, Handle


def test_what_cannot_be_taken_costs_one_line():
    with Graph() as g:
        bad = g.start('identifier', {'channels': ['bad name']}, wait=False)
        first = g.start('recorder', {'flash': 0.2, 'use_sim_time': False})
        command = first.command
        lost = Handle(
            g, 'lost', [*command[:3], '--ros-args', '--params-file', 'no.yaml'], g.folder / 'lost'
        )
        twin = Handle(
            g, 'recorder', [*command[:3], 'flush:=0.2', '--rate', '3'], g.folder / 'twin'
        )
        g.handles += [lost, twin]
        lost.is_ended = True
        for handle, said in ((bad, "channels: 'bad name'"), (lost, 'params file')):
            assert handle.process.wait(60) == 2
            assert said in handle.log and 'Traceback' not in handle.log
        g.wait(lambda: 'did you mean flush?' in first.log, 'the misspelt parameter')
        g.wait(lambda: '--rate 3 is passed over' in twin.log, 'the arguments')
        for handle in (first, twin):
            g.wait(lambda h=handle: 'another node is called /recorder' in h.log, 'the namesake')
            assert handle.log.count('is no parameter of this node') == (handle is first)
        for handle in (first, twin):
            handle.send(signal.SIGINT)
            assert handle.process.wait(60) == 0
