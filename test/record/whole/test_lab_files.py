# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A lab's own files are read as they are; what cannot be known is asked for in one line."""

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
import shlex
import sys

import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main
from piezo_ident.cli.console import Console
from piezo_ident.cli.files import read_all, spans
from piezo_ident.cli.main import cli
from piezo_ident.common.errors import DataError
import pytest
import scipy.io

RATE = 5000.0
N = 2000
TAB = '\t'
K = np.arange(N)
V = np.round(5 + 4 * np.sin(K / 40) * K / N, 4)
UM = np.round(7.5 * V, 3)
LVM = """\
LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t,
X_Columns\tOne
Time_Pref\tRelative
Date\t2024/05/06
Time\t10:11:12,345
***End_of_Header***\t
\t
Channels\t2\t\t\t
Samples\t2000\t2000\t\t
X_Start\t1\t1\t\t
X_Stop\t2\t2\t\t
Date\t2024/05/06\t2024/05/06\t\t
Time\t10:11:12,345\t10:11:12,345\t\t
X_Dimension\tTime\tTime\t\t
X0\t0,0E+0\t0,0E+0\t\t
Delta_X\t0,000200\t0,000200\t\t
***End_of_Header***\t\t\t\t
"""


def rows(*columns, separator=',', comma=False) -> str:
    lines = (
        separator.join(map(str, row)) for row in zip(*(c.tolist() for c in columns), strict=True)
    )
    text = '\n'.join(lines) + '\n'
    return text.replace('.', ',') if comma else text


def tabs(*columns) -> str:
    """Return rows with tabs and decimal commas."""
    return rows(*columns, separator='\t', comma=True)


def table(folder: Path, header: str, *columns, name: str = 'r.csv') -> Path:
    """Write columns below a header, which may be of several lines."""
    path = folder / name
    path.write_text(f'{header}\n{rows(*columns)}')
    return path


def write_tdms(path: Path, *channels) -> Path:
    """Write channels of a group, a name, samples and properties."""
    tdms = pytest.importorskip('nptdms')
    with tdms.TdmsWriter(path) as writer:
        for group, name, x, properties in channels:
            writer.write_segment([tdms.ChannelObject(group, name, x, properties)])
    return path


def assert_is_the_motion(piece, v=V) -> None:
    assert piece.sample_rate == RATE
    np.testing.assert_array_equal(piece.v, v)
    np.testing.assert_allclose(piece.y, 1e-6 * UM, rtol=1e-12)


def over_midnight(seconds: float) -> str:
    hour = '23:59' if seconds < 60 else '00:00'
    return f'{hour}:{seconds % 60:07.4f}'


START = datetime(2026, 11, 26, 23, 59, 59, 900_000)
#: one decimal more than milliseconds, as a period of 0.2 ms needs
ISO = [START + k * timedelta(microseconds=200) for k in range(N)]
ISO = np.array([f'{x.isoformat(timespec="microseconds")[:-2]}Z' for x in ISO])
DAY = np.array([over_midnight(round(59.9 + k / RATE, 4)) for k in range(N)])
PLAIN, GERMAN = (rows(K / RATE, V, UM), rows(K / RATE, V, UM, separator=';', comma=True))
#: tables as programs write them, UTF-8 unless they say otherwise
TEXTS: dict[str, str | bytes] = {
    'names.csv': 'time_s,voltage,position_um,note\n' + rows(K / RATE, V, UM, K),
    'german.csv': 'sep=;\r\nZeit [ms];Spannung [V];Weg [\u00b5m]\r\n'.encode('cp1252')
    + rows(np.round(K / 5, 1), V, UM, separator=';', comma=True).encode(),
    'unicode.txt': f'T\tV\tY\n{rows(K / RATE, V, UM * 1e-6, separator=TAB)}'.encode('utf-16'),
    'quoted.csv': (
        '"t [s]","v [V]","y [\u03bcm]"\n"' + GERMAN.replace(';', '","').replace('\n', '"\n"')[:-1]
    ).encode('utf-8-sig'),
    'labview.lvm': f'{LVM}X_Value\tVoltage\tPosition (um)\tComment\n'
    + tabs(K / RATE, V, UM).replace('\n', '\tstarted\n', 1),
    'units.lvm': LVM.replace('X_Dimension', 'Y_Unit_Label\tVolts\tum\t\t\nX_Dimension')
    + f'X_Value\tDrive\tStrain gauge\tComment\n{tabs(K / RATE, V, UM)}',
    'without_time.lvm': f'{LVM}X_Value\tVoltage\tPosition (um)\tComment\n\t'
    + tabs(V, UM).replace('\n', '\n\t')[:-1],
    'commented.txt': '# run 7\n#\n# Time[s]\tU_out[V]\tx[um]\n'
    + PLAIN.replace(',', TAB).replace('\n0.1\t', '\n# somebody touched the table\n0.1\t'),
    'without_time.txt': 'DAQ log\n10 May\n\nVoltage (V)\tPosition (um)\n'
    + rows(V, UM, separator=TAB),
    'scope.csv': f'Time,Drive,Position\n(ms),(V),(\u00b5m)\n\n{rows(K / 5, V, UM)}',
    'two_lines.txt': f'y\tv\tt\num\tV\tms\n\n{rows(UM, V, K / 5, separator=TAB)}',
    'microseconds.csv': 't_us,u,pos_nm\n' + rows(K * 200, V, np.round(1e3 * UM)),
    'rounded.csv': 't,v,y\n' + rows(np.round(K / RATE, 3), V, 1e-6 * UM),
    'blanks.dat': '% made by hand\n% time [s]  voltage [V]  displacement [um]\n'
    + PLAIN.replace(',', '  '),
    'headless.csv': rows(V, UM),
    'iso.csv': 'timestamp,voltage,position_um\n' + rows(ISO, V, UM),
    'iso_german.csv': 'Zeit;Spannung [V];Weg [um]\n' + rows(DAY, V, UM, separator=';', comma=True),
}


def struct_mat(path: Path) -> None:
    scipy.io.savemat(path, {'run1': {'time': K / RATE, 'U': V, 'pos_um': UM}, 'note': 'hello'})


def matrix_mat(path: Path) -> None:
    scipy.io.savemat(path, {'data': np.column_stack([V, UM]), 'fs': RATE})


def any_npz(path: Path) -> None:
    np.savez(path, time_ms=K / 5, voltage=V, displacement_um=UM, meta=np.array([{}]))


def v73_mat(path: Path) -> None:
    h5py = pytest.importorskip('h5py')
    with h5py.File(path, 'w', userblock_size=512) as file:
        for name, x in (('Time', K / RATE), ('Voltage', V), ('Position_um', UM)):
            file[f'scan/{name}'] = x[None]
        file['#refs#/a'] = np.arange(4)
    with path.open('r+b') as file:
        file.write(b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(124) + b'\x00\x02IM')


def daq_h5(path: Path) -> None:
    h5py = pytest.importorskip('h5py')
    with h5py.File(path, 'w') as file:
        file['daq/drive'], file['daq/sensor'] = V, UM
        file['daq/drive'].attrs['units'] = 'V'
        file['daq/sensor'].attrs['units'] = '\u00b5m'
        file['daq'].attrs['sample_rate'] = RATE


def daq_tdms(path: Path) -> None:
    wave = {'wf_increment': 1 / RATE, 'wf_start_offset': 0.0}
    drive = ('Log', 'Command', V, {**wave, 'unit_string': 'Volts'})
    write_tdms(path, drive, ('Log', 'Strain gauge', UM, {**wave, 'unit_string': 'um'}))


def daq_parquet(path: Path) -> None:
    arrow = pytest.importorskip('pyarrow')
    parquet = pytest.importorskip('pyarrow.parquet')
    when = np.datetime64('2024-05-06T10:11:12') + K * np.timedelta64(200, 'us')
    table = {'time': when, 'voltage [mV]': 1e3 * V, 'position_um': UM}
    parquet.write_table(arrow.table(table), path)


#: what writes each file that is no text, by its name
WRITERS = {
    'struct.mat': struct_mat,
    'matrix.mat': matrix_mat,
    'any.npz': any_npz,
    'v73.mat': v73_mat,
    'daq.h5': daq_h5,
    'daq.tdms': daq_tdms,
    'daq.parquet': daq_parquet,
}
#: what a file does not tell by itself
OPTIONS = {
    'without_time.txt': '--rate 5e3',
    'headless.csv': '--columns v=1,y=2 --rate 5000 --displacement-unit um',
    'matrix.mat': '--columns v=data.1,y=data.2 --displacement-unit \u00b5m',
}


@pytest.mark.parametrize('name', [*TEXTS, *WRITERS])
def test_the_file_is_read_without_editing(tmp_path, capsys, name):
    path, out = tmp_path / name, tmp_path / 'out.npz'
    if name in WRITERS:
        WRITERS[name](path)
    else:
        text = TEXTS[name]
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    argv = ['convert', str(path), str(out), *shlex.split(OPTIONS.get(name, ''))]
    assert main(argv) == 0, capsys.readouterr().err
    (piece,) = pi.read(out).pieces
    assert (piece.n, piece.sample_rate, piece.start_time) == (N, RATE, 0.0)
    np.testing.assert_allclose(piece.v, V, rtol=1e-12)
    np.testing.assert_allclose(piece.y, 1e-6 * UM, rtol=1e-12)
    # what was guessed is printed
    said = capsys.readouterr().err
    assert (' v is ' in said) is (said.count('\n') == 1) is (name != 'rounded.csv')
    assert ("t is 'X_Value' in s" in said) is (name in ('labview.lvm', 'units.lvm'))


@pytest.mark.parametrize(
    ('header', 'words'),
    [
        ('time,out,volt_a,volt_b', ['may be the voltage', '--columns v=volt_a', 'volt_b']),
        ('time,U,U,pos', ['2 columns may be the voltage (U, U)', '--columns v=2 or', 'v=3']),
        ('t,v_x,v_y,y_x,y_y', ['--columns y=y_x or --columns y=y_y; for two axes', 'v_b and y_b']),
        ('t,drive_1,drive_2,pos_1,pos_2', ['v=drive_2; for two axes name all columns']),
        ('t,Vx [V],X [um],Vy [V],Y [um]', ["'v=Vy [V]'; for two axes name all columns"]),
        ('t,v,y_x,y_y', ['2 columns may be the displacement', '--columns y=y_x or']),
        ('t,v,y,v', ['column v stands there twice', '--columns v=2']),
        ('time,voltage,ai0,ai1', ['y missing', '--columns y=ai0']),
        ('time,ai0,ai1,ai2', ['v, y missing', '--columns v=ai0,y=ai1']),
        ('a,b,c,d', ['t, v, y missing', '--columns t=a,v=b,y=c', '--rate 20e3']),
        ('time,voltage,Weg [inch],d', ["unit 'inch' is unknown", '--displacement-unit um']),
        ('time,n,Sensor voltage [V],position', ['v missing', '--columns v=n']),
        ('time,voltage', ['y missing', 'add a column named y']),
        ('ai0,ai1', ['t, v, y missing', '--columns v=ai0,y=ai1 --rate 20e3']),
        ('voltage,position', ['t missing', 'give the sampling rate, as in --rate 20e3']),
        ('time [h],voltage,pos,d', ["unit 'h' is unknown", '--time-unit']),
        ('0.1,1,2,3', ['no header line', '--columns t=1,v=2,y=3']),
    ],
)
def test_what_a_header_does_not_say_is_asked_for(tmp_path, header, words):
    columns = (K / RATE, V, 1e-6 * UM, V, V)[: header.count(',') + 1]
    path = table(tmp_path, header, *columns)
    with pytest.raises(DataError) as caught:
        pi.read(path)
    message = str(caught.value)
    assert message.isprintable() and all(word in message for word in (str(path), *words)), message
    assert ('for two axes' in message) == ('for two axes' in ''.join(words))


@pytest.mark.parametrize(
    ('choices', 'words'),
    [
        ({'columns': 't=1,v=2,y=5'}, ["no column '5'", 'a, b']),
        ({'columns': 't=1,v=2,z=3'}, ["'z' is no quantity", '--columns']),
        ({'columns': 't=1,v'}, ["'v' is no pair", '--columns']),
        ({'columns': 't=a,t=b'}, ['t comes twice', '--columns']),
        ({'columns': {'t': 'a', 'v': 'b', 'y': 'c'}, 'rate': 5e3}, ['--rate', 'drop one']),
        ({'columns': {'t': 'a', 'v': 'b', 'y': 'c'}}, ['113 m', '--displacement-unit um or nm']),
        ({'columns': 't=a,v=b,y=c', 'rate': -1.0}, ['a rate of -1 Hz']),
        ({'rate': '5e3'}, ['rate: expected Real, got str', 'as in 20e3']),
        ({'time_unit': 'h'}, ["unknown time unit 'h'", 'ms']),
    ],
)
def test_options_that_do_not_fit_the_file(tmp_path, choices, words):
    path = table(tmp_path, 'a,b,c', K / RATE, V, 2 * UM)
    with pytest.raises(DataError) as caught:
        pi.read(path, **choices)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_one_run_of_several_in_groups(tmp_path, capsys):
    path, out = tmp_path / 'runs.npz', tmp_path / 'out.npz'
    runs = [{f'run{i}.time': K / RATE, f'run{i}.voltage': V + i} for i in (1, 2)]
    np.savez(path, **runs[0], **runs[1], **{f'run{i}.position_um': UM for i in (1, 2)})
    assert main(['convert', str(path), str(out)]) == 2
    # the command that is shown is typed
    shown = capsys.readouterr().err.partition('for example: piezo_ident ')[2]
    assert main(shlex.split(shown.replace('run1', 'run2'))) == 0
    np.testing.assert_array_equal(pi.read(out).pieces[0].v, V + 2)


def test_segments_and_channels_of_other_names(tmp_path):
    path = tmp_path / 'r.csv'
    lines = [f'{k / RATE},{V[k]},{UM[k]},20.5,{"noise" if k > 99 else ""}' for k in range(N)]
    path.write_text('\n'.join(['Time [s],U,s [um],T1,phase', *lines]))
    (piece,) = pi.read(path, columns='segment=phase,x_temperature=T1').pieces
    assert [(s.label, s.start) for s in piece.segments] == [('noise', 100)]
    assert [*piece.channels] == ['temperature']


def test_units_that_nobody_named_and_that_are_unlikely_are_said(tmp_path):
    path = table(tmp_path, 't,v,y', K / 5, 1e3 * V, 1e-4 * UM)
    doubts = {f.name: f.action for f in pi.read(path).faults}
    assert doubts.keys() == {'slow_sampling', 'large_stroke', 'high_voltage'}
    assert '--time-unit ms' in doubts['slow_sampling']
    assert '--displacement-unit' in doubts['large_stroke']
    assert '--voltage-unit mV' in doubts['high_voltage']
    named = pi.read(path, time_unit='ms', voltage_unit='mV', displacement_unit='mm')
    assert (named.pieces[0].sample_rate, named.faults) == (RATE, ())


def test_volts_of_a_sensor_and_of_a_monitor(tmp_path, capsys):
    path = table(tmp_path, 'Zeit (ms),Monitor (mV),Sensor (V)', 1e3 * K / RATE, 50 * V, UM / 10)
    with pytest.raises(DataError, match=r'V .*--displacement-unit 10um'):
        pi.read(path, columns='y=Sensor (V)')
    given = ['--columns', 'y=Sensor (V)', '--displacement-unit', '10um', '--voltage-unit', '20mV']
    assert main(['convert', *given, str(path), str(tmp_path / 'o.npz')]) == 0
    assert "y is 'Sensor (V)' in 10um" in capsys.readouterr().err
    (piece,) = pi.read(tmp_path / 'o.npz').pieces
    np.testing.assert_allclose(piece.v, V, rtol=1e-6)
    np.testing.assert_allclose(piece.y, 1e-6 * np.asarray(UM), rtol=1e-5)
    assert main(['convert', '--voltage-unit', '-20V', str(path), str(tmp_path / 'p.npz')]) == 2


@pytest.mark.parametrize(
    ('header', 'rate', 'kind', 'cure'),
    [
        ('time', 2.0, 'slow', '--time-unit ms'),
        ('time_s', 2.0, 'slow', '--time-unit 1ms'),
        ('t [ms]', 0.002, 'slow', '--time-unit 1us'),
        ('time_s', 2e6, 'fast', 'is the time unit right?'),
        ('time_ms', 5e3, 'fast', '--time-unit 1s'),
    ],
)
def test_a_rate_that_no_stage_has_is_said(tmp_path, capsys, header, rate, kind, cure):
    path = table(tmp_path, f'{header},voltage,position_um', K / rate, V, UM)
    doubts = {f.name: f.action for f in pi.read(path).faults}
    assert cure in doubts[f'{kind}_sampling']
    assert main(['convert', str(path), str(tmp_path / 'o.npz')]) == 0
    assert cure in capsys.readouterr().err
    if cure.startswith('--'):
        assert main(['convert', str(path), str(tmp_path / 'p.npz'), *cure.split()]) == 0


@pytest.mark.parametrize(
    ('header', 'rate', 'kind', 'cure'),
    [
        ('voltage,position_um', 5.0, 'slow_sampling', '--rate 20e3'),
        ('voltage,position_um', 5e6, 'fast_sampling', '--rate 20e3'),
        ('voltage_mV,position_um', 5e3, 'large_gain', '--voltage-unit'),
        ('Sample interval: 0.2\nCH1 (V),CH2 (um)', None, 'slow_sampling', '--rate 5000'),
    ],
)
def test_a_slip_of_a_thousand_is_said(tmp_path, capsys, header, rate, kind, cure):
    path, options = table(tmp_path, header, V, UM), ['--rate', str(rate)] if rate else []
    assert main(['convert', str(path), str(tmp_path / 'o.npz'), *options]) == 0
    assert cure in capsys.readouterr().err
    assert cure in {f.name: f.action for f in pi.read(path, rate=rate).faults}[kind]


def test_time_that_is_rounded_is_not_guessed_where_two_rates_fit(tmp_path):
    path = table(tmp_path, 't,v,y', np.round(K / 4967.3, 3), V, 1e-6 * UM)
    with pytest.raises(DataError, match=r'two different samples.*--rate 496\d'):
        pi.read(path)
    assert pi.read(path, rate=4967.3).pieces[0].sample_rate == 4967.3


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    for suffix, package in (('h5', 'h5py'), ('tdms', 'npTDMS'), ('parquet', 'pyarrow')):
        path = tmp_path / f'r.{suffix}'
        path.touch()
        monkeypatch.setitem(sys.modules, {'npTDMS': 'nptdms'}.get(package, package), None)
        monkeypatch.delitem(sys.modules, 'pyarrow.parquet', raising=False)
        with pytest.raises(DataError, match=f'pip install {package}'):
            pi.read(path)
        monkeypatch.undo()


def test_a_tdms_file_may_hold_channels_of_other_rates(tmp_path):
    def written(name, period_of_y, *slow):
        every = [('Command', V, 1 / RATE), ('Position', UM * 1e-6, period_of_y), *slow]
        channels = [
            (f'G{i}', title, x, {'wf_increment': period})
            for i, (title, x, period) in enumerate(every)
        ]
        return write_tdms(tmp_path / name, *channels)

    slow = ('Temperature', V[:20], 100 / RATE)
    for name, order in (('last.tdms', [slow]), ('alone.tdms', [])):
        assert pi.read(written(name, 1 / RATE, *order)).pieces[0].sample_rate == RATE
    with pytest.raises(DataError, match=r'v and y .* 0\.0002 s and 0\.002 s'):
        pi.read(written('two.tdms', 10 / RATE))


def test_a_tdms_file_that_ends_early_says_so(tmp_path):
    path = tmp_path / 'scan.tdms'
    daq_tdms(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match=r'scan\.tdms: .* \d+ of \d+ samples'):
        pi.read(path)


def test_signals_with_a_name_beside_their_samples(tmp_path):
    # as of dSPACE's ControlDesk, and as Simulink's structure with time
    def struct(**fields):
        found = np.empty((1, 1), dtype=[(name, object) for name in fields])
        found[0, 0] = tuple(fields.values())
        return found

    def signal(name, unit, x):
        return struct(Name=f'{{"Model Root"/"IO"/"{name}"}}', Unit=unit, Data=x[None, :])

    signals = [signal('pos', 'um', UM), signal('u_cmd', 'V', V)]
    signals += [signal('Out1', '-', 0 * V), signal('Out1', '-', V)]
    time = struct(Name='Time', Unit='s', Data=K[None, :] / RATE)
    scipy.io.savemat(tmp_path / 'd.mat', {'e1': struct(X=time, Y=np.hstack(signals))})
    labelled = [struct(values=x[:, None], label=name) for name, x in (('pos_um', UM), ('u', V))]
    simulink = struct(time=K[:, None] / RATE, signals=np.hstack(labelled))
    scipy.io.savemat(tmp_path / 's.mat', {'out': simulink})
    for name in ('d.mat', 's.mat'):
        assert_is_the_motion(pi.read(tmp_path / name).pieces[0])
    # two of one name keep their numbers
    other = pi.read(tmp_path / 'd.mat', columns='v=e1.Y.4.Data')
    np.testing.assert_array_equal(other.pieces[0].v, V)


@pytest.mark.parametrize(
    ('head', 'columns', 'asks'),
    [
        (
            'x-axis,1,x-axis,2\nsecond,Volt,second,Volt',
            (K / RATE, V, K / RATE, UM / 10),
            ('--columns t=1 or', "--columns 'v=1 [Volt]' or", "--columns 'y=2 [Volt]'"),
        ),
        (
            'X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-1.0e-01,2.0e-04',
            (K, V, UM / 10, np.full(N, '')),
            ("--columns 'v=CH1 [Volt]'", "--columns 'y=CH2 [Volt]'"),
        ),
    ],
    ids=['channels called by numbers', 'increment in the header'],
)
def test_an_oscilloscope_asks_for_one_column_after_the_other(
    tmp_path, capsys, head, columns, asks
):
    path, out = table(tmp_path, head, *columns), str(tmp_path / 'o.npz')
    given = []
    for said in asks:
        # each line asks for what is missing, as it is typed
        assert main(['convert', str(path), out, *given]) == 2
        assert said in capsys.readouterr().err
        given += shlex.split(said.removesuffix(' or'))
    assert main(['convert', str(path), out, *given, '--displacement-unit', '10um/V']) == 0
    assert_is_the_motion(pi.read(out).pieces[0])
    if head.startswith('x-axis'):
        by_number = pi.read(path, columns='t=1,v=2,y=4', displacement_unit='10um')
        assert_is_the_motion(by_number.pieces[0])


@pytest.mark.parametrize('suffix', ['txt', 'lvm', 'h5', 'tdms', 'parquet'])
def test_damaged_files(tmp_path, suffix):
    path = tmp_path / f'r.{suffix}'
    for data in (b'', b'\x89HDF\r\n\x1a\n', np.random.default_rng(0).bytes(3000)):
        path.write_bytes(data)
        with pytest.raises(DataError) as caught:
            pi.read(path)
        assert str(caught.value).isprintable()


# --- units of headers and options -----------------------------------------------------------


def scope_h5(path: Path, names: dict) -> None:
    h5py = pytest.importorskip('h5py')
    with h5py.File(path, 'w') as file:
        for name, x in names.items():
            base, unit = name.split('_')
            file[f'run/{base}'] = x
            file[f'run/{base}'].attrs['Units'] = np.array([unit.encode()])


def scope_tdms(path: Path, names: dict) -> None:
    split = [(*name.split('_'), x) for name, x in names.items()]
    write_tdms(path, *(('run', base, x, {'unit_string': unit}) for base, unit, x in split))


#: what writes columns by name, and the name of the displacement
SCOPE = {
    'csv': (lambda path, c: table(path.parent, ','.join(c), *c.values(), name=path.name), 'B_mV'),
    'npz': (lambda path, c: np.savez(path, **c), 'B_mV'),
    'mat': (lambda path, c: scipy.io.savemat(path, {'run': c}), 'run.B_mV'),
    'h5': (scope_h5, 'run/B'),
    'tdms': (scope_tdms, 'run/B'),
}


@pytest.mark.parametrize('suffix', SCOPE)
def test_units_are_judged_the_same_way_in_every_format(tmp_path, suffix):
    k = np.arange(300)
    v = 5.0 - 5.0 * np.cos(0.1 * k)
    path, (write, y) = tmp_path / f'scope.{suffix}', SCOPE[suffix]
    # a sensor of 0.1 V at full stroke, in mV, and a voltage in kV
    write(path, {'time_ms': 1.0 * k, 'drive_kV': 1e-3 * v, 'B_mV': 10.0 * v})
    columns = {'y': y}
    (piece,) = pi.read(path, columns=columns, displacement_unit='10um/V').pieces
    assert piece.sample_rate == 1000.0
    np.testing.assert_allclose(piece.v, v, rtol=1e-9)
    np.testing.assert_allclose(piece.y, 1e-7 * v, rtol=1e-9)
    with pytest.raises(DataError, match=r'--displacement-unit 10um/V'):
        pi.read(path, columns=columns, displacement_unit='um')


@pytest.mark.parametrize(
    ('header', 'choices', 'v_by', 'y_by'),
    [
        # a factor is of one volt, whatever the header counts in
        ('t,drive [V],B [mV]', {'displacement_unit': '1um/V'}, 1.0, 1e-9),
        ('t,drive [V],B [mV]', {'displacement_unit': '1um'}, 1.0, 1e-9),
        ('t,drive [mV],B [mV]', {'displacement_unit': 'um/V', 'voltage_unit': '20V'}, 0.02, 1e-9),
        ('t,drive [kV],B [V]', {'displacement_unit': '1um/V', 'voltage_unit': '20V'}, 2e4, 1e-6),
        # of the unit in the header, where it is the same
        ('t,drive [mV],B [um]', {'voltage_unit': '20mV'}, 0.02, 1e-6),
        # a plain unit that the header has, or that nobody contradicts
        ('t,drive [mV],B [um]', {'displacement_unit': 'um', 'voltage_unit': 'mV'}, 1e-3, 1e-6),
        ('t,drive,B [a.u.]', {'displacement_unit': 'um', 'voltage_unit': 'mV'}, 1e-3, 1e-6),
        # a number overrules a header that is wrong
        ('t,drive [V],B [um]', {'displacement_unit': '1nm', 'voltage_unit': '1mV'}, 1e-3, 1e-9),
        ('t,drive [mV],B [um]', {'voltage_unit': '1000V'}, 1.0, 1e-6),
    ],
)
def test_units_of_header_and_option(tmp_path, header, choices, v_by, y_by):
    path = table(tmp_path, header, K / RATE, V, UM)
    (piece,) = pi.read(path, columns='v=2,y=3', **choices).pieces
    np.testing.assert_allclose(piece.v, v_by * V, rtol=1e-12)
    np.testing.assert_allclose(piece.y, y_by * UM, rtol=1e-12)


@pytest.mark.parametrize(
    ('header', 'choices', 'words'),
    [
        ('t,drive [mV],B [um]', '--voltage-unit V', ['drive [mV]', '--voltage-unit 1000V']),
        ('t,drive [V],B [um]', '--voltage-unit mV', ['drive [V]', '--voltage-unit 1mV']),
        ('t,drive [V],B [um]', '--displacement-unit nm', ['B [um]', '--displacement-unit 1nm']),
        ('t,drive [V],B [um]', '--displacement-unit 10um/V', ['B [um]', 'leave the option out']),
        ('t [ms],drive [V],B [um]', '--time-unit s', ['t [ms]', '--time-unit 1s']),
    ],
)
def test_a_unit_that_the_header_contradicts_is_asked_about(
    tmp_path, capsys, header, choices, words
):
    path, out = table(tmp_path, header, K / RATE, V, UM), str(tmp_path / 'o.npz')
    argv = ['convert', str(path), out, '--columns', 'v=2,y=3']
    assert main([*argv, *choices.split()]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in (str(path), choices.split()[0], *words)), said
    # what overrules the header is typed
    if words[1].startswith('--'):
        assert main([*argv, *words[1].split()]) == 0


def test_an_axis_keeps_the_unit_of_its_own_header(tmp_path):
    path = table(tmp_path, 't,v [mV],y,v_b,y_b [nm]', K / RATE, V, UM, V, UM)
    (piece,) = pi.read(path, displacement_unit='um', voltage_unit='20V').pieces
    np.testing.assert_allclose(piece.channels['v_b'], piece.v, rtol=1e-12)
    np.testing.assert_allclose(1e3 * piece.channels['y_b'], piece.y, rtol=1e-12)


def test_what_the_units_make_of_the_numbers_is_printed(tmp_path, capsys):
    names = 'Time,Channel A,Channel B\n(ms),(V),(mV)\n\n'
    v = 5.0 - 5.0 * np.cos(0.1 * np.arange(300))
    n = np.arange(300.0)
    paths = [
        table(tmp_path, names, n, v, 100.0 * i * v, name=name)
        for i, name in enumerate(('a.csv', 'b.csv'), 1)
    ]
    given = ['--columns', 'v=2,y=3', '--displacement-unit', '1um/V']
    assert main(['convert', *given, str(paths[0]), str(tmp_path / 'o.npz')]) == 0
    printed = capsys.readouterr()
    for text in (printed.err, printed.out):
        assert 'stroke 1 um' in text and 'voltage 0 to 10 V' in text
    args = cli.main(['identify', *given, *map(str, paths)], standalone_mode=False)
    both = read_all(paths, args, Console())
    assert 'a.csv and 1 more' in (said := capsys.readouterr().err) and 'stroke 1 to 2 um' in said
    # of a motion that is wanted no voltage is known
    unknown = [replace(p, v=np.full(p.n, np.nan)) for p in both[0]]
    assert spans([replace(both[0], pieces=tuple(unknown))]) == 'stroke 1 um'


def test_a_stroke_that_is_none_brings_a_unit_that_is_taken(tmp_path, capsys):
    path = table(tmp_path, 't [s],drive [V],pos [mm]', K / RATE, V, UM)
    out = str(tmp_path / 'o.npz')
    assert main(['convert', str(path), out]) == 2
    shown = capsys.readouterr().err.partition('for example: piezo_ident ')[2]
    assert main(shlex.split(shown)) == 0
    np.testing.assert_allclose(pi.read(out).pieces[0].y, 1e-6 * UM, rtol=1e-12)
    # a number that somebody gave is not answered by the same again
    with pytest.raises(DataError, match='read in 1m,') as caught:
        pi.read(path, displacement_unit='1m')
    assert not caught.value.options
    path.write_text(f't [s],drive [V],pos [um]\n{rows(1e12 + K, V, UM)}')
    with pytest.raises(DataError, match='--time-unit 1ms'):
        pi.read(path)


# --- names as other programs print them -----------------------------------------------------


@pytest.mark.parametrize(
    'columns',
    [
        {'v': 'run1/ao0', 'y': 'run1/ai0'},
        {'v': '/run1/ao0', 'y': 'run1.ai0'},
        {'v': 'RUN1/AO0', 'y': 'run1/both(:,2)'},
        {'v': 'run 2/ao0', 'y': 'run1/ai0'},
    ],
)
def test_columns_by_the_path_in_an_hdf5_file(tmp_path, columns):
    h5py = pytest.importorskip('h5py')
    with h5py.File(tmp_path / 'r.h5', 'w') as file:
        file['run1/ao0'], file['run1/ai0'], file['run 2/ao0'] = V, UM, V + 1
        file['run1/both'] = np.column_stack([V, UM])
        file['run1/both'].attrs['unit'] = 'um'
        file['run1/ai0'].attrs['unit'] = 'um'
    (piece,) = pi.read(tmp_path / 'r.h5', columns=columns, rate=RATE).pieces
    assert_is_the_motion(piece, V + ('2' in columns['v']))


@pytest.mark.parametrize(
    'columns',
    [
        {'v': 'Log/out', 'y': 'Log/Strain gauge'},
        {'v': "/'Log'/'out'", 'y': "/'Log'/'Strain gauge'"},
        {'v': 'Log.out', 'y': 'Strain gauge'},
        {'v': 'Log/out', 'y': 'Log Strain/gauge'},
    ],
)
def test_columns_by_group_and_channel_of_a_tdms_file(tmp_path, columns):
    wave = {'wf_increment': 1 / RATE}
    channels = [('Log', 'out', V, {**wave, 'unit_string': 'V'})]
    channels += [('B', 'out', -V, wave)]
    # in the last case the words are those of another path
    is_another = columns['y'] == 'Log Strain/gauge'
    for group, name in [('Log', 'Strain gauge'), ('Log Strain', 'gauge')][: 1 + is_another]:
        channels.append((group, name, UM, {**wave, 'unit_string': 'um'}))
    path = write_tdms(tmp_path / 'r.tdms', *channels)
    if is_another:
        with pytest.raises(DataError, match=r'no column .Log Strain/gauge'):
            pi.read(path, columns=columns)
        return
    assert_is_the_motion(pi.read(path, columns=columns).pieces[0])


def test_columns_by_the_fields_of_matlab_structs(tmp_path):
    signals = np.empty((1, 2), dtype=[('values', object), ('label', object)])
    signals[0] = [(UM[:, None], 'pos_um'), (V[:, None], 'u')]
    out = {'time': K / RATE, 'signals': signals}
    run = {'ao0': V, 'ai0_um': UM, 'm': np.column_stack([UM, V])}
    scipy.io.savemat(tmp_path / 's.mat', {'out': out, 'run': run})
    for columns in (
        {'v': 'out.signals(2).values', 'y': 'out.signals(1).values'},
        {'v': 'run.m(:,2)', 'y': 'run/ai0_um'},
    ):
        assert_is_the_motion(pi.read(tmp_path / 's.mat', columns=columns, rate=RATE).pieces[0])


# --- the sampling rate in a header ----------------------------------------------------------


@pytest.mark.parametrize(
    ('head', 'end'),
    [
        ('CH1 (V),CH2 (um),t0 = -0.1, tInc = 2.0e-04,', ',,'),
        ('CH1 (V),CH2 (um),,', ',,'),
        ('Sample interval,0.2,ms\nCH1 (V),CH2 (um)', ''),
        ('"Sampling time","200 us"\n"CH1 (V)","CH2 (um)"', ''),
        ('Sampling rate,5000,5000\nCH1 (V),CH2 (um),', ''),
        ('Sample rate (kS/s): 5\nCH1 (V),CH2 (um)', ','),
        ('HResolution,2.0e-04\nCH1 (V),CH2 (um)', ''),
        ('Tinterval,2.0e-04\nCH1 (V),CH2 (um)', ''),
    ],
)
def test_a_sample_time_above_the_table(tmp_path, head, end):
    path = tmp_path / 'r.csv'
    path.write_text(f'{head}\n' + rows(V, UM).replace('\n', f'{end}\n'))
    options = {} if any(x in head for x in '=:') or '\n' in head else {'rate': RATE}
    assert_is_the_motion(pi.read(path, **options).pieces[0])


@pytest.mark.parametrize(
    'head',
    [
        'Recording interval: 0.2 ms\nCH1 (V),CH2 (um)',
        'Recording interval: 0.2 ms',
        'Recording interval: 0.2 ms\nTime,CH1 (V),CH2 (um)',
    ],
)
def test_a_rate_that_is_suggested_is_the_one_in_the_file(tmp_path, capsys, head):
    columns = (V, UM) if 'Time' not in head else (np.array(['now'] * N), V, UM)
    path, out = table(tmp_path, head, *columns), str(tmp_path / 'o.npz')
    assert main(['convert', str(path), out]) == 2
    shown = capsys.readouterr().err.partition('for example: piezo_ident ')[2]
    assert main([*shlex.split(shown), '--displacement-unit', 'um']) == 0
    assert pi.read(out).pieces[0].sample_rate == RATE


def test_the_columns_of_the_run_that_was_named_are_suggested(tmp_path):
    h5py = pytest.importorskip('h5py')
    with h5py.File(tmp_path / 'r.h5', 'w') as file:
        for run in ('run1', 'run2'):
            for name, column in (('time', np.arange(V.size) / RATE), ('ao0', V), ('pos', UM)):
                file[f'{run}/{name}'] = column
    with pytest.raises(DataError, match=r'v=run2\.\w+') as refusal:
        pi.read(tmp_path / 'r.h5', columns={'t': 'run2.time'})
    assert 'run1' not in refusal.value.options
