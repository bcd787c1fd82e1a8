# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures: they hold the data of the result, and say why they cannot be drawn."""

from dataclasses import replace
from itertools import combinations, pairwise
import re

from diagnosis_examples import example, HOSTILE
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
import numpy as np
import piezo_ident as pi
from piezo_ident.model.free_run import piece_runs, PieceRun
from piezo_ident.model.sines import sines_of
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.record.record import Piece, Segment
from piezo_ident.report import save_plot
from piezo_ident.report.figures.delay_and_dynamics import response_figure
from piezo_ident.report.figures.diagnosis import draw_diagnosis, errors_figure
from piezo_ident.report.figures.free_run import loops_figure, overview_figure, sines_figure
from piezo_ident.report.figures.identification import draw_identification
from piezo_ident.report.figures.residual import (
    residual_coherence_figure,
    residual_dependence_figure,
    residual_figure,
    residual_spectrum_figure,
)
from piezo_ident.report.figures.style import axis_limit, draw_each, envelope, NothingToDraw, safe
from piezo_ident.report.table import length, number
from piezo_ident.residual.analysis import analyse
from piezo_ident.residual.stretches import ResidualPart
import pytest


@pytest.fixture(scope='module')
def runs(identified):
    return piece_runs(identified.model, identified.records, identified.memories)


def lines_of(figure):
    """Return the data of all named lines, by name."""
    return {
        line.get_label(): line.get_xydata()
        for axes in figure.axes
        for line in axes.lines
        if not line.get_label().startswith('_')
    }


def test_every_picture_has_finite_data_and_labelled_axes(identified, runs):
    pictures = [
        *draw_identification(identified, runs).pictures,
        *draw_diagnosis(example('class')).pictures,
    ]
    assert len(pictures) > 12
    for picture in pictures:
        assert picture.title
        assert picture.caption
        drawn = [axes for axes in picture.figure.axes if axes.axison and axes.has_data()]
        assert drawn, picture.name
        assert any(axes.get_xlabel() for axes in drawn), picture.name
        for axes in drawn:
            assert np.all(np.isfinite([*axes.get_xlim(), *axes.get_ylim()])), picture.name
        data = [line.get_ydata() for axes in drawn for line in axes.lines]
        data += [bar.get_window_extent().size for axes in drawn for bar in axes.patches]
        assert any(np.isfinite(np.asarray(y, float)).any() for y in data), picture.name


def test_overview_shows_measurement_and_model_and_sines_are_those_of_the_result(runs):
    y, y_hat = runs[1].piece.y, runs[1].y_hat
    lines = lines_of(overview_figure(runs[1]))
    shown = lines['measured'][:, 1]
    assert (shown.min(), shown.max()) == pytest.approx((1e6 * y.min(), 1e6 * y.max()))
    # the error is the last line that is called model
    assert np.abs(lines['model'][:, 1]).max() == pytest.approx(1e9 * np.abs(y - y_hat).max())
    errors = sines_of(runs)
    lines = lines_of(sines_figure(errors))
    expected = [(e.frequency, e.percent) for e in errors]
    assert np.allclose(lines['model with dynamics'], expected)


def test_a_band_of_an_unknown_start_leaves_the_error_readable():
    y = 1e-5 * np.sin(np.linspace(0.0, 30.0, 900))
    run = PieceRun('r', Piece(1e6 * y, y, 1000.0), y + 1e-8, y + 1e-8)
    half = np.geomspace(1e-4, 2e-8, y.size)
    assert overview_figure(run, half_width=half).axes[2].get_ylim()[1] < 150.0


def test_bars_are_the_errors_of_the_diagnosis():
    result = example('named')
    widths = [bar.get_width() for bar in errors_figure(result).axes[0].patches]
    n = 1 + len(result.before.by_segment)
    assert widths[::n] == [e.overall for e in (result.before, result.refit, result.after)]


def drawn_of(result, name):
    """Draw one picture of an identification alone."""

    def one(wanted, tick):
        return draw_each([x for x in wanted if x[0] == name], tick)

    runs = piece_runs(result.model, result.records, result.memories)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr('piezo_ident.report.figures.identification.draw_each', one)
        (picture,) = draw_identification(result, runs).pictures
    return picture


def test_a_model_fitted_to_all_is_not_drawn_as_if_a_part_were_held_out(unlabelled, identified):
    overview = drawn_of(unlabelled, 'overview_1')
    error = number(unlabelled.error('held out'))
    assert f'held out before were missed by {error} %' in overview.caption
    assert f'held out before: {error} %' in overview.figure.axes[1].get_title('right')
    assert not overview.figure.axes[1].patches
    # three steps leave out what they hold out
    overview = drawn_of(identified, 'overview_1')
    assert 'held out' not in overview.caption + overview.figure.axes[1].get_title('right')


def test_what_decides_about_the_delay_is_said(identified):
    def delay(**changes):
        changed = replace(identified.delay, **changes)
        return drawn_of(replace(identified, delay=changed), 'delay')

    step = identified.delay.step
    k = int(np.flatnonzero(step.lag == 1)[0])
    response = step.response.copy()
    response[k] = -np.sign(response[-1]) * 3.0 * step.threshold
    found = delay(step=replace(step, response=response))
    assert 'two samples in a row' in found.caption
    assert 'free run' not in found.caption
    # above the threshold, but no beginning of the response
    assert 1.0 in lines_of(found.figure)['other direction'][:, 0]
    assert 'noise threshold' in found.figure.axes[0].get_legend_handles_labels()[1]
    scan = identified.delay.samples + 4
    assert 'differ: a free run decided' in delay(scan=scan).caption
    other = delay(samples=identified.delay.samples + 2)
    assert 'A free run decided for another delay' in other.caption
    assert f'steps: {step.samples}' in lines_of(other.figure)


def test_a_signature_tells_how_much_flatter_it_became():
    figure = {p.name: p.figure for p in draw_diagnosis(example('named')).pictures}['signature']
    sizes = re.findall(
        r'rms of the curves: (\S+) → (\S+) [µnp]m', figure.axes[0].get_title('right')
    )
    ((before, after),) = sizes
    assert float(after) < float(before)


def test_captions_of_a_diagnosis_name_only_what_is_drawn():
    result = example('named')
    bare = tuple(replace(r, piece=replace(r.piece, segments=())) for r in result.residuals)
    for each, shaded in ((result, True), (replace(result, residuals=bare), False)):
        pictures = {p.name: p for p in draw_diagnosis(each).pictures}
        residual, spectrum = pictures['residual_1'], pictures['spectrum']
        assert bool(residual.figure.axes[0].patches) is shaded
        assert ('shaded' in residual.caption) is shaded
        assert 'lines' not in lines_of(spectrum.figure)
        assert 'lines' not in spectrum.caption
    (r,) = result.residuals
    hum = r.after + 50e-9 * np.sin(2.0 * np.pi * 50.0 * r.piece.t)
    figure = residual_spectrum_figure(analyse([ResidualPart(r.record, r.piece, hum, r.sound)]))
    assert 'lines' in lines_of(figure)


def test_every_cut_of_a_residual_is_said():
    (residual,) = example('named').residuals
    after = residual.after.copy()
    k = int(np.flatnonzero(residual.sound)[100])
    after[k] = 20.0 * np.abs(after).max()
    titles = [a.get_title('right') for a in residual_figure(replace(residual, after=after)).axes]
    largest = f'largest {1e9 * after[k]:.3g} nm'
    assert any('times enlarged' in text and largest in text for text in titles), titles


def test_without_a_refinement_nothing_is_drawn_as_refined():
    (given,), (refined,) = example('unexplained').residuals, example('named').residuals
    assert len(residual_figure(given).axes) == 2
    # on the same scale, and enlarged
    assert len(residual_figure(refined).axes) == 4


def test_a_refit_is_drawn_as_one_model_beside_the_given_one():
    result = example('refitted')
    axes = errors_figure(result).axes[0]
    assert axes.get_legend_handles_labels()[1] == [
        'noise',
        'as given',
        'H refitted, nothing added',
    ]
    n = 1 + len(result.before.by_segment)
    assert [bar.get_width() for bar in axes.patches][::n] == [
        result.before.overall,
        result.after.overall,
    ]
    # both on one scale, and the refit enlarged
    assert len(residual_figure(result.residuals[0]).axes) == 3
    captions = [p.caption for p in draw_diagnosis(result).pictures]
    assert sum('after: H refitted, nothing added' in text for text in captions) >= 2


def boxes_of(figure):
    """Return text and box [pixels] of every label, name, title and legend that is drawn."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = []
    for axes in (x for each in figure.axes for x in (each, *each.child_axes) if x.axison):
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in axis.get_major_ticks():
                if low <= tick.get_loc() <= high:
                    drawn += [tick.label1, tick.label2]
            drawn.append(axis.label)
        drawn += [axes.title, *axes.texts]
    legends = [axes.get_legend() for axes in figure.axes]
    texts = [(x.get_text(), x) for x in drawn if x.get_visible() and x.get_text().strip()]
    texts += [('legend', x) for x in legends if x is not None]
    return [(name, x.get_window_extent(canvas.get_renderer())) for name, x in texts]


def assert_legible(figure):
    """Let no label cover another, or lie outside of the picture."""
    boxes = boxes_of(figure)
    for (one, a), (other, b) in combinations(boxes, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        assert min(across, min(a.y1, b.y1) - max(a.y0, b.y0)) <= 1.0, (one, other)
    for name, box in boxes:
        assert min(box.x0, box.y0) >= -1.0, name
        assert box.x1 <= figure.bbox.x1 + 1.0, name
        assert box.y1 <= figure.bbox.y1 + 1.0, name


def test_modes_close_together_are_named_apart(identified):
    def mode(frequency, damping):
        pole = np.exp(2 * np.pi * frequency / 20e3 * (-damping + 1j * np.sqrt(1 - damping**2)))
        return np.real(np.poly([pole, np.conj(pole)]))

    a = np.polymul(np.polymul(mode(2000, 0.02), mode(2050, 0.03)), mode(700, 0.05))
    G = Dynamics(a[1:], [a.sum()])
    found = replace(
        identified,
        model=replace(identified.model, dynamics=G),
        dynamics=replace(identified.dynamics, covariance=np.zeros((0, 0))),
    )
    figure = response_figure(found)
    assert_legible(figure)
    assert {text.get_text() for text in figure.axes[0].texts} == {'700 Hz', '2000 Hz'}


def test_names_of_short_segments_keep_apart():
    (residual,) = example().residuals
    edges = np.linspace(2000, 4000, 41).astype(int)
    steps = tuple(Segment('step', a, b) for a, b in pairwise(edges))
    piece = replace(residual.piece, segments=(*steps, Segment('triangle', 4000, residual.piece.n)))
    axes = residual_figure(replace(residual, piece=piece)).axes[0]
    places = sorted(name.xy[0] for name in axes.texts)
    assert len(places) > 2
    assert np.diff(places).min() > 0.03 * piece.duration


def test_pictures_that_cannot_be_drawn_say_why(runs):
    piece = Piece(np.zeros(50), np.zeros(50), 1000.0)
    still = replace(runs[0], piece=piece, y_hat=piece.y, y_static=piece.y)
    with pytest.raises(NothingToDraw, match='voltage'):
        loops_figure([still])
    with pytest.raises(NothingToDraw, match='sine'):
        sines_figure([])
    empty = analyse([ResidualPart('r', piece, np.zeros(50))])
    with pytest.raises(NothingToDraw, match='spectrum'):
        residual_spectrum_figure(empty)
    with pytest.raises(NothingToDraw, match='curve'):
        residual_dependence_figure(empty)
    with pytest.raises(NothingToDraw, match='50 samples'):
        residual_coherence_figure(empty)
    result = example('unexplained')
    deaf = replace(result.residuals[0], sound=np.zeros(result.residuals[0].piece.n, dtype=bool))
    with pytest.raises(NothingToDraw, match=f'{deaf.record}: .* {deaf.sound.size} samples'):
        residual_figure(deaf)
    left_out = dict(draw_diagnosis(replace(result, residuals=(deaf,))).left_out)
    assert 'Spectrum of the residual' in left_out


def test_decimated_traces_keep_their_extremes():
    y = np.sin(np.arange(300_007) / 50.0)
    y[123_456], y[300_006] = 9.0, -7.0
    k = envelope(y)
    assert k.size < 3100
    assert {0, 123_456, 300_006} <= set(k.tolist())
    assert np.all(np.diff(k) > 0)
    # every stretch between drawn samples lies within what is drawn around it
    assert y[k].max() == 9.0
    assert y[k].min() == -7.0
    assert np.array_equal(envelope(y[:100]), np.arange(100))
    # a stretch that was left out breaks the line, a sample alone does not hide the others
    broken = y.copy()
    broken[150_000:180_000] = broken[::7] = np.nan
    k = envelope(broken)
    assert np.isnan(broken[k][(k > 150_200) & (k < 179_800)]).all()
    assert np.nanmax(broken[k]) == np.nanmax(broken) and np.nanmin(broken[k]) == np.nanmin(broken)
    assert axis_limit(broken)[1] == np.nanmax(abs(broken))
    assert axis_limit(np.full(3, np.nan)) == (0.0, 0.0)
    assert axis_limit(y) == (pytest.approx(2.5, rel=0.01), 9.0)
    assert axis_limit(y[:1000]) == pytest.approx((1.0, 1.0), rel=0.01)


def test_labels_in_pictures_are_plain_text():
    assert safe('a$b\x07') == r'a\$b?'
    assert len(safe('x' * 500)) == 60


def test_results_draw_and_show_themselves(identified, runs, tmp_path, coarse):
    run = pi.free_run(identified.model, identified.records[1])
    numbers = (length(identified.stroke), str(run.errors.n), number(example().after.overall))
    for result, text in zip((identified, run, example()), numbers, strict=True):
        figure = result.plot()
        figure.savefig(tmp_path / 'plot.png', dpi=30)
        assert np.any(imread(tmp_path / 'plot.png')[..., :3] < 0.5)
        assert text in repr(result)
        assert len(repr(result).splitlines()) < 40
        html = result._repr_html_()
        assert text in html
        assert '<img src="data:image/png;base64,' in html
        assert HOSTILE not in html
    y = lines_of(run.plot())['measured'][:, 1]
    assert y.max() == pytest.approx(1e6 * run.measured.max())


def test_plot_in_a_file(identified, tmp_path, coarse):
    run = pi.free_run(identified.model, identified.records[1])
    save_plot(run, tmp_path / 'p.png')
    assert np.any(imread(tmp_path / 'p.png')[..., :3] < 0.5)
    save_plot(run, tmp_path / 'p.svg')
    with pytest.raises(pi.ConfigError, match=r'\.png'):
        save_plot(run, tmp_path / 'p.gif')
    with pytest.raises(pi.DataError, match='nowhere'):
        save_plot(run, tmp_path / 'nowhere' / 'p.png')
