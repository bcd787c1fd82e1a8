# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Whatever a user gets wrong ends in one line that names it and the cure, before any work."""

import contextlib
import shlex
import sqlite3

from command_line import csv_text, refuse, succeed, table
import numpy as np
import piezo_ident as pi
import pytest
import yaml

#: columns of a table, and what is said of it
BAD_COLUMNS: tuple[tuple[dict[str, np.ndarray], str], ...] = (
    ({'y': np.where(np.arange(1000) % 50, table()['y'], np.nan)}, 'cut the bad stretch'),
    ({'v': np.ones(1000), 'y': 1e-6 * np.sin(np.arange(1000) / 9)}, 'while it is driven'),
    ({'y': np.full(1000, 1e-6)}, 'sensor'),
    ({'y': 7.5 * table()['v']}, '--displacement-unit'),
)


@pytest.mark.parametrize(('columns', 'cure'), BAD_COLUMNS)
def test_bad_data(capsys, tmp_path, columns, cure):
    path = tmp_path / 'bad.csv'
    path.write_text(csv_text(**columns))
    argv = ['identify', path, '--model', tmp_path / 'm.yaml', '--report', tmp_path / 'r']
    refuse(capsys, tmp_path, argv, path.name, cure)


#: a command, and what it says; R is a record, S that of a sine, M a model, T an empty place
COMMANDS = (
    # names
    ("identify ''", 'is empty; give a name'),
    ("identify R --model ''", 'is empty; give a name'),
    ("identify R --validation ''", 'is empty; give a name'),
    ("identify R --voltage-topic ' '", 'is empty; give a name'),
    ("simulate --config '' T/r.csv", 'is empty; give a name'),
    ("convert R ''", 'is empty; give a name'),
    ('identify T/no.csv', 'no.csv', 'check the name'),
    ('convert T/no T/r.csv', 'no', ';'),
    ('identify T/empty', 'T/empty', 'give a bag'),
    ('simulate --program validaton T/r.csv', 'mean validation?'),
    ('simulate --config stage_papper T/r.csv', 'mean paper?'),
    ('simulate --config T/crep.yaml T/r.csv', 'crep.yaml', 'creep'),
    ('simulate --program T/sinus.yaml T/r.csv', 'sinus.yaml', 'sine'),
    # options
    ('convert --displacement-unit ym T/r.csv T/r.csv', 'nm'),
    ('identify R --thresholds many', '--thresholds'),
    ('identify R --thresholds 1', 'thresholds'),
    ('identify R --order 3', '--order'),
    ('identify R --order 3,0', 'order'),
    ('identify R --solver magic', '--solver'),
    ('identify R --seed -1', '--seed'),
    ('identify R --hold-out -1', 'hold_out'),
    ('identify R --hold-out inf', 'hold_out'),
    ('identify R --model m.csv', 'm.csv'),
    # two outputs at one path
    (
        'identify R --model T/new.yaml --report T/new.yaml',
        '--model',
        '--report',
        'T/new.yaml',
        'one path',
    ),
    (
        'identify R --report T/m.yaml --model T/no/../m.yaml',
        '--report',
        'T/no/../m.yaml',
        'one path',
    ),
    ('identify R --report T/loop.yaml --model T/loop.yaml', '--report', 'T/loop.yaml', 'one path'),
    ('diagnose M R --model T/new.yaml --report T/new.yaml', '--model', 'T/new.yaml', 'one path'),
    ('predict M R --out T/p.csv --plot T/p.csv', '--out', '--plot', 'T/p.csv', 'one path'),
    ('invert M R --plot T/p.csv --out T/p.csv', '--plot', '--out', 'T/p.csv', 'one path'),
    ('identify R --mdoel m.yaml', '--mdoel'),
    ('identify T/slow.csv --voltage-limits 0 8', 'slow.csv', 'check the limits'),
    ('identify T/slow.csv --voltage-limits 8 0', '--voltage-limits'),
    ('simulate --sample-rate 1000 T/r.csv', 'stage_paper.yaml', 'leave out --sample-rate'),
    ('simulate --limits 9 0 T/r.csv', '--limits', 'the lower one first'),
    ('simulate --voltage-only T/bag', 'T/bag', '.csv'),
    *(
        (f'simulate {option} {out}', option.split()[0].strip('-'), 'leave it out')
        for option in ('--seed 2', '--storage mcap')
        for out in ('T/p.yaml', '--voltage-only T/p.csv')
    ),
    # options of bags, for tables
    ('identify R --namespace other', 'is for bags', 'record.npz'),
    ('predict M R --voltage-topic v', 'is for bags', 'record.npz'),
    ('convert R T/r.csv --displacement-topic y', 'is for bags', 'record.npz'),
    ('identify R --each T/out --overwrite', 'does not go with --each'),
    ('identify R --each T/out --namespace other', 'is for bags', 'record.npz'),
    ('export M --out T/s.h --name 3x', 'a letter first, as in --name stage\n'),
    # models and records that do not go together
    ('predict R M', 'MODEL comes first: piezo_ident predict'),
    ('predict R R', 'MODEL comes first: piezo_ident predict'),
    ('predict M M', 'MODEL comes first: piezo_ident predict'),
    ('predict T R', 'MODEL comes first: piezo_ident predict'),
    ('predict M T/slow.csv', 'slow.csv', '1000 Hz', 'identify a model'),
    ('identify R --validation R', 'is no validation'),
    ('identify R --validation T/again.npz', 'again.npz', 'is no validation'),
    ('identify T/um.csv R --displacement-unit um', 'record.npz', 'one unit holds for all'),
    ('identify T/um.csv --validation R', 'um.csv', 'piezo_ident convert'),
    # links that lead nowhere
    ('identify T/gone.csv', 'gone.csv: is a link to', 'mend the link'),
    ('convert R --overwrite T/gone.csv', 'gone.csv: is a link to', 'mend the link'),
    ('predict T/loop.yaml R', 'loop.yaml: is a link to', 'mend the link'),
    ('simulate --config T/loop.yaml T/r.csv', 'is a link to', 'mend the link'),
    ('identify R --model T/loop.yaml', 'is a link to', 'mend the link'),
    ('identify T/loop.yaml', 'loop.yaml: is a link to', 'mend the link'),
    ('identify R --each T/loop.yaml', 'loop.yaml: cannot be written'),
    ('identify R --report T/gone.csv/below', 'gone.csv: is a link to', 'mend the link'),
)
#: outputs that could not be written, which is found before the work
OUTPUTS = (
    ('identify R --model T/file/m.yaml', 'T/file/m.yaml'),
    ('identify R --model /proc/m.yaml', '/proc/m.yaml'),
    ('identify R --model T', ';'),
    ('identify R --model T/no/m.yaml', 'make it first'),
    ('identify R --report T/file', 'T/file'),
    ('identify R --report /proc/report', '/proc/report'),
    ('identify R --report T/mine', 'T/mine'),
    ('predict M R --out T/file/y.csv', 'T/file/y.csv'),
    ('predict M R --plot T/file/y.png', 'T/file/y.png'),
    ('predict M R --out R', ';'),
    ('predict M R --out T/y.mat', 'y.mat'),
    ('predict M R --out T/y', 'written without an ending; choose .csv, .npz'),
    ('simulate T/file/r.csv', 'T/file/r.csv'),
    ('simulate --overwrite /dev/null', 'device'),
    (f'simulate T/{"x" * 300}.csv', 'cannot be written'),
    ('convert R T/file', 'T/file', '--overwrite'),
    ('convert R T/R.MCAP', 'small letters'),
    ('convert T/days.npz T/out.mcap', 'cannot be the stamp', 'let t begin at zero'),
    ('convert T/days.npz T/out', 'cannot be the stamp', 'let t begin at zero'),
)


@pytest.fixture(scope='module')
def places(tmp_path_factory, made):
    """Return a record, a model, and a folder of all that is wrong, which no refusal changes."""
    folder = tmp_path_factory.mktemp('wrong')
    for name in ('empty', 'mine'):
        (folder / name).mkdir()
    for name in ('file', 'mine/model.yaml'):
        (folder / name).write_text('')
    (folder / 'slow.csv').write_text(csv_text())
    (folder / 'um.csv').write_text(csv_text(y=7.5 * table()['v']))
    # days since year 0, as seconds
    np.savez(folder / 'days.npz', **{**table(), 't': table()['t'] + 7.4e5 * 86400.0})
    stage = yaml.safe_load((made / 'stage.yaml').read_text())
    stage['effects'] = [{'name': 'crep', 'parameters': {}}]
    (folder / 'crep.yaml').write_text(yaml.safe_dump(stage))
    (folder / 'sinus.yaml').write_text('limits: [0, 10]\nsegments: [{signal: sinus}]\n')
    (folder / 'gone.csv').symlink_to('nowhere.csv')
    (folder / 'loop.yaml').symlink_to('loop.yaml')
    (folder / 'again.npz').symlink_to(made / 'record.npz')
    return {'R': made / 'record.npz', 'M': made / 'model.yaml', 'T': folder}


@pytest.mark.parametrize('case', (*COMMANDS, *OUTPUTS), ids=lambda case: case[0][:60])
def test_what_cannot_work(capsys, places, monkeypatch, case):
    if case in OUTPUTS:
        for work in (
            'identify_command.identify',
            'model_command.free_run',
            'record_command.SimulatedStage',
        ):
            monkeypatch.delattr(f'piezo_ident.cli.{work}')

    def filled(word: str) -> str:
        head, slash, rest = word.partition('/')
        return f'{places[head]}{slash}{rest}' if head in places else word

    command, *words = case
    refuse(capsys, places['T'], list(map(filled, shlex.split(command))), *map(filled, words))


@pytest.mark.parametrize(
    ('text', 'cure'),
    [
        ('schema_version: 99\n', 'update piezo_ident'),
        (': : :\n\t{', 'write it again'),
        ('- 1\n', 'mapping'),
        ('', 'mapping'),
        ('<p>' * 200_000, 'too large for a model'),
        ('schema_version: 1\n', 'is this a model file'),
    ],
)
def test_bad_model(capsys, tmp_path, made, text, cure):
    path = tmp_path / 'model.yaml'
    path.write_text(text)
    argv = ['predict', path, made / 'sine.csv', '--out', tmp_path / 'y.csv']
    refuse(capsys, tmp_path, argv, path, cure)


def test_convert_keeps_its_input(capsys, tmp_path, made):
    bag, file = tmp_path / 'bag', tmp_path / 'r.csv'
    for path in (bag, file):
        succeed(capsys, 'convert', made / 'record.npz', path)
    (tmp_path / 'link.csv').symlink_to(file)
    for there, out in (
        (file, file),
        (tmp_path / 'link.csv', file),
        (file, bag / '..' / 'r.csv'),
        (bag, bag),
        (bag / 'bag.mcap', bag),
        (bag, bag / 'r.csv'),
    ):
        for option in ([], ['--overwrite']):
            refuse(capsys, tmp_path, ['convert', there, out, *option], out, 'is the input')


def test_bags(capsys, tmp_path, made, monkeypatch):
    bag = tmp_path / 'bag'
    succeed(capsys, 'convert', '--storage', 'sqlite3', made / 'record.npz', bag)
    argv = ['identify', bag, '--voltage-topic', 'displacement']
    refuse(capsys, tmp_path, argv, '/displacement carries displacement, not voltage', '/voltage')
    (data,) = bag.glob('*.db3')
    with contextlib.closing(sqlite3.connect(data)) as connection, connection:
        connection.execute('delete from messages')
    refuse(capsys, tmp_path, ['identify', bag], bag, 'record the stage')
    pi.write(pi.read(made / 'record.npz'), tmp_path / 'r.mcap')
    (tmp_path / 'r.mcap').rename(tmp_path / 'R.MCAP')
    refuse(capsys, tmp_path, ['identify', tmp_path / 'R.MCAP'], 'R.MCAP', 'rename it')
    # an output without a name
    monkeypatch.chdir(bag)
    refuse(capsys, tmp_path, ['convert', made / 'record.npz', '.', '--overwrite'], 'no file')


def test_a_voltage_alone_where_a_displacement_is_needed(capsys, tmp_path, made):
    scan = tmp_path / 'scan.csv'
    scan.write_text(csv_text('y', t=np.arange(1000) / 2000.0))
    refuse(capsys, tmp_path, ['identify', scan], scan.name, 'y missing')
    argv = ['predict', made / 'model.yaml', scan, '--plot', tmp_path / 'p.png']
    refuse(capsys, tmp_path, argv, scan.name, '--plot')
