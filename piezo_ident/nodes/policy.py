# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Who may say and ask what, as a policy for SROS2: made from the tables of the graph.

    python -m piezo_ident.nodes.policy config/security/policy.xml

A test compares the file with the tables.  What no line allows is denied: only the excitation (and
the player, whose enclave need not be made) publishes `voltage`, only the operator calls services
and sets parameters, but for the three that the identifier asks of the excitation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
import sys

from piezo_ident.nodes.interfaces import SERVICES, TOPICS
from piezo_ident.nodes.parameters import NODES, RECORDER

__all__ = ['OPERATOR', 'PARAMETERS', 'main', 'policy', 'rights']

#: the enclave of whoever starts runs, sets parameters and looks
OPERATOR = 'operator'
#: services that every node has by itself
PARAMETERS = (
    'describe_parameters',
    'get_parameters',
    'get_parameter_types',
    'list_parameters',
    'set_parameters',
    'set_parameters_atomically',
    'get_type_description',
)


def _recorded() -> tuple[str, ...]:
    (topics,) = (d.default for d in RECORDER if d.name == 'topics')
    return topics if isinstance(topics, tuple) else ()


#: what a node hears beside what the table of topics says
_HEARS: Mapping[str, tuple[str, ...]] = {
    # whether somebody else plays
    'excitation': ('voltage',),
    'identifier': ('excitation/status',),
    'recorder': _recorded(),
}
#: what a node asks of another
_ASKS: Mapping[str, tuple[str, ...]] = {
    'identifier': ('excitation/set_parameters', 'excitation/start', 'excitation/stop'),
}
_EVERY = ('~/status', '/diagnostics')


def rights(node: str) -> dict[str, tuple[str, ...]]:
    """
    Return what a node may do.

    Returns
    -------
    dict
        Names of topics under 'publish' and 'subscribe', of services under 'reply' and 'request'.
    """
    if node == OPERATOR:
        own = [f'{s.node}/{s.name}' for s in SERVICES]
        asked = [f'{n}/{p}' for n in NODES for p in PARAMETERS]
        topics = [t.name for t in TOPICS if t.name not in _EVERY]
        seen = [*topics, *(f'{n}/status' for n in NODES), '/diagnostics']
        return _sorted(
            publish=('/rosout', '/parameter_events'), subscribe=seen, reply=(), request=own + asked
        )
    said = [t.name for t in TOPICS if node in t.publishers]
    heard = [t.name for t in TOPICS if node in t.subscribers]
    own = [f'~/{s.name}' for s in SERVICES if s.node == node]
    return _sorted(
        publish=(*said, *_EVERY, '/rosout', '/parameter_events'),
        subscribe=(*heard, *_HEARS.get(node, ())),
        reply=(*own, *(f'~/{p}' for p in PARAMETERS)),
        request=_ASKS.get(node, ()),
    )


def _sorted(**names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    return {key: tuple(sorted(set(value))) for key, value in names.items()}


def policy() -> str:
    """Return the policy as XML: an enclave a node, and one for the operator."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<!-- Made by: python -m piezo_ident.nodes.policy config/security/policy.xml -->',
        '<!-- For a graph in the namespace /; elsewhere put it into every ns="...". -->',
        '<policy version="0.2.0">',
        '  <enclaves>',
    ]
    for node in (*NODES, OPERATOR):
        lines += [
            f'    <enclave path="/piezo_ident/{node}">',
            '      <profiles>',
            f'        <profile ns="/" node="{node}">',
        ]
        for right, names in rights(node).items():
            kind = 'topic' if right in ('publish', 'subscribe') else 'service'
            if not names:
                continue
            lines.append(f'          <{kind}s {right}="ALLOW">')
            lines += [f'            <{kind}>{name}</{kind}>' for name in names]
            lines.append(f'          </{kind}s>')
        lines += ['        </profile>', '      </profiles>', '    </enclave>']
    return '\n'.join([*lines, '  </enclaves>', '</policy>', ''])


def main() -> None:
    """Write the file named on the command line."""
    Path(sys.argv[1]).write_text(policy(), encoding='utf-8')


if __name__ == '__main__':
    main()
