# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Long bags at the prompt: converted and predicted as short ones are, in constant memory."""

import json
from pathlib import Path
import subprocess
import sys

import numpy as np
from piezo_ident.cli import main
from piezo_ident.cli.console import Console
from piezo_ident.common.errors import DataError
from piezo_ident.model import long_prediction
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run
from piezo_ident.model.long_prediction import predict_long
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.record import long_bag
from piezo_ident.record.bags.read import write_bag
from piezo_ident.record.io import read_long, read_record, write_record
from piezo_ident.record.long_record import LongRecord, NeedsWhole
from piezo_ident.record.record import Piece, Record, Segment
import pytest

RATE, WINDOW = 20_000.0, 4000


def model(*effects: EffectSetting) -> StageModel:
    paper = SimulatedStage.load('paper').model
    return StageModel(
        paper.sample_rate,
        paper.scaling,
        paper.hysteresis,
        paper.dynamics,
        paper.delay,
        tuple(effects),
    )


def drive(n: int, phase: float, slow: float = 1.0) -> np.ndarray:
    k = np.arange(n) / n
    return 5.0 + 4.5 * np.sin(2 * np.pi * (3 * k * slow + phase)) * np.minimum(1.0, 0.2 + k)


def record(*starts: float, n: int = 15_000) -> Record:
    """Return pieces that begin at some times, the last one from rest."""
    pieces = []
    for i, start in enumerate(starts):
        v = drive(n, 0.1 * i)
        if i == len(starts) - 1:
            v = v * np.minimum(1.0, np.arange(n) / 500)
        y = model().predict_piece(Piece(v, np.zeros(n), RATE))
        y += 1e-8 * np.random.default_rng(i).normal(size=n)
        pieces.append(Piece(v, y, RATE, start, (Segment('noise', 100, n - i),)))
    return Record(tuple(pieces), 'r')


@pytest.fixture
def bag(tmp_path) -> Path:
    """Return a bag with a short gap, a long one, and a clock that starts over."""
    write_bag(record(0.0, 0.8, 5.0, 0.0), tmp_path / 'bag')
    return tmp_path / 'bag'


@pytest.fixture
def short_windows(monkeypatch):
    monkeypatch.setattr(long_bag, 'WINDOW', WINDOW)


def said(capsys, *argv: object) -> dict:
    assert main([*map(str, argv), '--json']) == 0
    return json.loads(capsys.readouterr().out)


def nearly(one: object, other: object) -> None:
    """Compare two results; sums that are taken in parts differ in their last digits."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            nearly(one[key], other[key])
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-9, abs=1e-18)
    else:
        assert one == other


@pytest.mark.parametrize('suffix', ['.csv', '.npz'])
def test_prediction_of_a_long_bag_is_that_of_the_whole(bag, tmp_path, capsys, monkeypatch, suffix):
    model().save(tmp_path / 'm.yaml')
    out, results, files = tmp_path / f'o{suffix}', [], []
    for window in (long_bag.WINDOW, WINDOW):
        monkeypatch.setattr(long_bag, 'WINDOW', window)
        results.append(said(capsys, 'predict', tmp_path / 'm.yaml', bag, '--out', out))
        files.append(out.read_bytes())
    assert files[0] == files[1]
    for result in results:
        for fault in result['faults']:
            del fault['where']  # joined from those of the windows
    nearly(*results)
    assert results[1]['memory_estimated'] == [True, False, True, False]


def test_prediction_with_effects_and_further_range(bag, short_windows):
    narrow = model(EffectSetting('creep', {'gain': [0.02], 'time_constant': [0.3]}))
    narrow = StageModel(
        narrow.sample_rate,
        type(narrow.scaling)(0.0, 10.0, narrow.scaling.y0, narrow.scaling.Y, (1.0, 8.0)),
        narrow.hysteresis,
        narrow.dynamics,
        narrow.delay,
        narrow.effects,
    )
    long, parts = read_long(bag), []
    assert isinstance(long, LongRecord)
    got = predict_long(narrow, long, add=lambda part, y_hat: parts.append(y_hat))
    want = free_run(narrow, read_record(bag))
    np.testing.assert_allclose(np.concatenate(parts), want.predicted, rtol=0, atol=1e-15)
    assert got.warnings == want.warnings
    assert len(got.warnings) == 2
    assert got.estimated == want.estimated
    for one, other in ((got.whole, want.whole), (got.after, want.after)):
        nearly(vars(one), vars(other))


def test_range_that_is_swept_late_is_left_to_the_whole(
    bag, tmp_path, capsys, short_windows, monkeypatch
):
    monkeypatch.setattr(long_prediction, 'MOST', 100)
    with pytest.raises(NeedsWhole):
        predict_long(model(), read_long(bag))
    model().save(tmp_path / 'm.yaml')
    result = said(capsys, 'predict', tmp_path / 'm.yaml', bag, '--out', tmp_path / 'o.npz')
    assert result['whole']['n'] == 60_000


def test_conversion_of_a_long_bag(bag, tmp_path, capsys, short_windows):
    results = [said(capsys, 'convert', bag, tmp_path / name) for name in ('o.mat', 'o.npz')]
    for result in results:
        assert result['pieces'] == 4
        assert [f['name'] for f in result['faults']] == ['restart', 'gap']
        assert [f['count'] for f in result['faults']] == [1, 2]
    one, other = (read_record(tmp_path / name) for name in ('o.mat', 'o.npz'))
    for a, b in zip(one, other, strict=True):
        assert a.v.tobytes() == b.v.tobytes()
        assert (a.start_time, a.segments) == (b.start_time, b.segments)


def test_model_of_another_rate_is_refused(bag, tmp_path, capsys, short_windows):
    model().save(tmp_path / 'm.yaml')
    slow = load(tmp_path / 'm.yaml')
    slow = StageModel(5000.0, slow.scaling, slow.hysteresis, slow.dynamics, slow.delay)
    slow.save(tmp_path / 'slow.yaml')
    assert main(['predict', str(tmp_path / 'slow.yaml'), str(bag)]) == 2
    assert 'bag: the record is sampled at 20000 Hz, the model at 5000' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['o', 'o.mcap', 'o.csv', 'o.npz'])
@pytest.mark.parametrize('error', [OSError(28, 'No space left on device'), KeyboardInterrupt()])
def test_conversion_that_fails_leaves_nothing(
    bag, tmp_path, short_windows, monkeypatch, name, error
):
    def fail(step: str, share: float) -> None:
        if step == 'reading' and share > 0.3:
            raise error

    monkeypatch.setattr('piezo_ident.record.bags.samples.SHOWN', 100)
    long = read_long(bag, to_write=True, progress=fail)
    with pytest.raises((DataError, KeyboardInterrupt)) as caught:
        write_record(long, tmp_path / name, progress=fail)
    if isinstance(error, OSError):
        assert str(caught.value).startswith(f'{tmp_path / name}: cannot be written (No space')
    assert [p.name for p in tmp_path.iterdir()] == ['bag']


def test_progress_is_shown(bag, tmp_path, short_windows, monkeypatch):
    seen: dict[str, list[float]] = {}

    class Watched(Console):
        def progress(self):
            from contextlib import nullcontext

            return nullcontext(lambda step, share: seen.setdefault(step, []).append(share))

    monkeypatch.setattr('piezo_ident.cli.commands.Console', Watched)
    monkeypatch.setattr('piezo_ident.record.bags.samples.SHOWN', 100)
    assert main(['convert', str(bag), str(tmp_path / 'o')]) == 0
    assert list(seen) == ['checking', 'reading']
    for shares in seen.values():
        assert shares == sorted(shares)
        assert shares[0] == 0.0
        assert 0.8 < shares[-1] <= 1.0


# runs in an interpreter of its own, whose peak memory it prints [MiB]
PEAK = """
import sys
from pathlib import Path
from piezo_ident.record import long_bag
from piezo_ident.cli import main

long_bag.WINDOW = 1 << 14
assert main(sys.argv[1:]) == 0
status = Path('/proc/self/status').read_text()
print(int(status.partition('VmHWM:')[2].split()[0]) / 1024)
"""


@pytest.mark.skipif(not Path('/proc/self/status').exists(), reason='Linux tells the peak memory')
@pytest.mark.parametrize('name', ['o', 'o.npz', 'prediction.npz'])
def test_memory_does_not_grow_with_the_bag(tmp_path, name):
    model().save(tmp_path / 'm.yaml')
    peaks = []
    for n in (80_000, 400_000):
        v = 5.0 - 5.0 * np.cos(2 * np.pi * 50.0 * np.arange(n) / RATE)
        write_bag(Record((Piece(v, 6e-6 * v, RATE),)), tmp_path / f'{n}')
        files = [str(tmp_path / f'{n}'), str(tmp_path / f'{n}_{name}')]
        verb = ['convert', *files]
        if name.startswith('prediction'):
            verb = ['predict', str(tmp_path / 'm.yaml'), files[0], '--out', files[1]]
        done = subprocess.run(
            [sys.executable, '-c', PEAK, *verb], capture_output=True, text=True, check=True
        )
        peaks.append(float(done.stdout.splitlines()[-1]))
    # 320,000 samples more: 25 MiB and more when they are read whole
    assert peaks[1] - peaks[0] < 12.0
