# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Several nodes in one process: the same topics, the same numbers, one end."""

import signal
import subprocess
import sys

from course import block, model_of, PROGRAM, QUICK
from graph import Graph
import numpy as np
import pytest
import yaml

CODE = 'import sys; from piezo_ident.nodes.composed import main; sys.exit(main())'


@pytest.mark.parametrize(
    ('names', 'said'),
    [
        ([], 'name each node once'),
        (['stage', 'stage'], 'name each node once'),
        (['stage', 'moddel'], "there is no node 'moddel'"),
    ],
)
def test_names_that_make_no_sense_are_refused(names, said):
    command = [sys.executable, '-c', CODE, *names]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert said in done.stderr and done.stderr.count('\n') == 1


def test_stage_model_and_identifier_in_one_process():
    with Graph() as g:
        for name in ('stage', 'model', 'identifier'):
            g.follow(f'lab/{name}', name)
        answers, predictions = g.collect('lab/displacement'), g.collect('lab/prediction')
        models = g.texts('lab/model')
        file = g.folder / 'composed.yaml'
        own = {**QUICK, 'program': PROGRAM}
        file.write_text(yaml.safe_dump({'/lab/identifier': {'ros__parameters': own}}))
        command = [sys.executable, '-c', CODE, 'stage', 'model', 'identifier', '--ros-args']
        command += ['-r', '__ns:=/lab', '--params-file', str(file)]
        process = subprocess.Popen(command, env=g.environment)
        try:
            g.wait(
                lambda: all(
                    g.status(f'lab/{n}')['state'] for n in ('stage', 'model', 'identifier')
                ),
                'all three to speak',
            )
            g.start('excitation', {'subscribers': 3, 'block_size': 1000}, 'lab')
            ok, reason = g.call('lab/identifier/run')
            assert ok, reason
            g.wait(lambda: g.status('lab/identifier')['state'] in ('done', 'failed'), 'the run')
            assert g.status('lab/identifier')['state'] == 'done', g.status('lab/identifier')
            g.wait(lambda: models, 'the model')
            assert model_of(models[-1]).delay.samples == 3
            g.wait(lambda: g.status('lab/model')['state'] == 'predicting', 'a prediction')
            before = len(predictions)
            g.publish('lab/voltage', block(10**7, np.full(100, 0.0), 'hold'), subscribers=3)
            g.wait(lambda: len(predictions) > before, 'the prediction of a block')
            assert answers
        finally:
            process.send_signal(signal.SIGINT)
            try:
                assert process.wait(60.0) == 0
            finally:
                process.kill()
