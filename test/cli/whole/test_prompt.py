# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What helps at the prompt: examples, guesses at misspelt words, completion, errors as JSON."""

from dataclasses import fields
from itertools import chain, pairwise
import json
import shlex
from types import SimpleNamespace

from command_line import refuse, run, succeed
import piezo_ident as pi
from piezo_ident.cli import main, options
from piezo_ident.cli.identify_command import prompt_of
from piezo_ident.cli.main import cli
from piezo_ident.record.options import ReadOptions
import pytest

VERBS = sorted(cli.commands)


def parsed(line: str) -> dict[str, object]:
    given = cli.main(shlex.split(line), 'piezo_ident', standalone_mode=False)
    assert given != 0, line
    return vars(given)


@pytest.mark.parametrize('verb', VERBS)
def test_every_help_has_examples_that_are_understood(capsys, verb):
    text = succeed(capsys, verb, '--help')
    lines = [x.strip() for x in text.partition('Examples:')[2].splitlines() if x.strip()]
    assert lines
    for line in lines:
        program, _, rest = line.partition(' ')
        assert program == 'piezo_ident'
        assert parsed(rest)['verb'] == verb
    # `-h` and no words at all help, too
    assert succeed(capsys, verb, '-h') == text
    assert 'Examples:' in succeed(capsys)


@pytest.mark.parametrize(
    ('line', 'guess'),
    [
        ('predcit m.yaml r.csv', 'did you mean predict?'),
        ('identfy r.csv', 'did you mean identify?'),
        ('xyzzy', 'give simulate, identify, predict'),
        ('identify r.csv --mdoel m.yaml', 'did you mean --model?'),
        ('convert a b --overwirte', 'did you mean --overwrite?'),
        ('--verison', 'did you mean --version?'),
        ('identify r.csv --model --report x', 'a name is missing before it'),
    ],
)
def test_misspelt_words(capsys, tmp_path, line, guess):
    assert 'piezo_ident' in refuse(capsys, tmp_path, shlex.split(line), guess, '--help)')


def test_what_a_file_lacks_is_added_to_the_command(capsys, tmp_path):
    path, lines = tmp_path / 'a file.csv', '\n'.join(f'{k},{k % 7},{k}' for k in range(99))
    path.write_text(f'voltage,position,unused\n{lines}')
    words = ['convert', str(path), str(tmp_path / 'out.npz')]
    for option in ('--rate 20e3', '--displacement-unit um'):
        message = refuse(capsys, tmp_path, words, option)
        words = shlex.split(message.partition('for example: piezo_ident ')[2])
    assert run(capsys, *words)[0] == 0


def test_the_help_of_a_unit_tells_of_volts_where_a_column_may_hold_them(capsys):
    text = ' '.join(succeed(capsys, 'identify', '--help').split())
    units = ['--time-unit', '--voltage-unit', '--displacement-unit', '--voltage-limits']
    of_unit = [text[text.index(a) : text.index(b)] for a, b in pairwise(units)]
    assert ['one volt of a' in x for x in of_unit] == [False, True, True]
    assert 'volt' not in of_unit[0]


def test_columns_may_be_given_in_parts_and_validation_takes_all_words_up_to_the_next_option():
    assert parsed('identify r.csv --columns t=a --columns v=b')['columns'] == 't=a,v=b'
    given = parsed('identify a b --validation c d --model m.yaml --validation e')
    assert list(map(str, given['records'])) == ['a', 'b']
    assert list(map(str, given['validation'])) == ['c', 'd', 'e']
    assert str(given['model']) == 'm.yaml'


def test_reading_options_are_fields_of_read_options():
    names = {option.name for option in options.READING}
    assert names < {field.name for field in fields(ReadOptions)}


@pytest.mark.parametrize(
    'options',
    [
        "--voltage-limits -5 5.5 --displacement-unit um --columns 't=time s,v=voltage,y=position'",
        "--columns 't=Zeit [s],v=2' --rate 5000 --time-unit ms",
    ],
)
def test_commands_that_are_suggested_read_records_in_the_same_way(options):
    first = parsed(f'identify a.csv {options}')
    prompt = prompt_of(SimpleNamespace(**first), [], [])
    assert parsed(prompt.command('identify', 'a.csv').partition(' ')[2]) == first


@pytest.mark.parametrize(
    ('words', 'wanted'),
    [
        ('pre', 'plain,predict'),
        ('identify --thre', 'plain,--thresholds'),
        ('identify rec', 'file,rec'),
        ('simulate --program vali', 'plain,validation'),
        ('effects cree', 'plain,creep'),
        ('convert --storage m', 'plain,mcap'),
    ],
)
def test_a_shell_completes(capsys, monkeypatch, words, wanted):
    line = f'piezo_ident {words}'
    asked = {'COMP_WORDS': line, 'COMP_CWORD': str(line.count(' '))}
    for name, value in {'_PIEZO_IDENT_COMPLETE': 'bash_complete', **asked}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit, match='0'):
        main([])
    assert wanted in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize('shell', ['bash', 'zsh', 'fish'])
def test_completion_script(capsys, shell):
    code, out, _ = run(capsys, '--completion', shell)
    assert code == 0
    assert f'_PIEZO_IDENT_COMPLETE={shell}_complete' in out


@pytest.mark.parametrize(
    ('line', 'kind'),
    [
        ('predict no.yaml no.csv', 'ConfigError'),
        ('convert no.csv no.npz', 'DataError'),
        ('effects crep', 'ConfigError'),
        ('identify no.csv --seed -1', 'UsageError'),
    ],
)
def test_errors_as_json(capsys, line, kind):
    code, out, err = run(capsys, *shlex.split(line), '--json')
    error = json.loads(out)['error']
    assert (code, error['kind'], error['exit_code']) == (2, kind, 2)
    assert error['message'] in err and err.count('\n') == 1


def test_no_verb_replaces_what_exists_unless_told(capsys, tmp_path, made):
    model, sine, program = made / 'model.yaml', made / 'sine.csv', made / 'sine.yaml'
    table, picture, copy = tmp_path / 'y.csv', tmp_path / 'y.png', tmp_path / 'copy.npz'
    learnt, report = tmp_path / 'm.yaml', tmp_path / 'report'
    fast = ['--order', '2,2', '--thresholds', '5']
    shipped = ['--config', made / 'stage.yaml', '--program', program]
    for argv, outputs in (
        (['predict', model, sine], [['--out', table], ['--plot', picture]]),
        (['convert', sine], [[copy]]),
        (['simulate', *shipped], [[tmp_path / 'r.npz']]),
        (['identify', made / 'record.npz', *fast], [['--model', learnt], ['--report', report]]),
        (['diagnose', model, sine, '--only', 'creep'], [['--model', tmp_path / 'd.yaml']]),
    ):
        succeed(capsys, *argv, *chain(*outputs))
        for output in outputs:
            refuse(capsys, tmp_path, [*argv, *output], output[-1], 'add --overwrite')
        succeed(capsys, *argv, *chain(*outputs), '--overwrite')
    assert pi.load(learnt).delay.samples == 2
