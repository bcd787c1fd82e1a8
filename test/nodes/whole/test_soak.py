# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The whole graph for some seconds, as `make soak` runs it for hours: nothing is lost."""

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from processes import take_domain
from soak import clock_drift, slope, soak, Stream


def test_what_is_missing_is_counted():
    stream = Stream()
    for first in (0, 100, 300, 0, 100):
        stream.take(first, 100)
    assert (stream.samples, stream.missing, stream.runs) == (500, 100, 2)
    t = np.linspace(0.0, 7200.0, 1000)
    k, error = slope(t, 3.0 + 2e-3 * t)
    assert k == pytest.approx(2e-3) and error < 1e-9
    # a sample clock that is 50 ppm fast, and blocks that come late by up to 30 ms
    rng = np.random.default_rng(1)
    late = 0.03 * rng.exponential(0.2, t.size)
    drift, error = clock_drift(
        [list(zip((t + late).tolist(), (t * (1 + 5e-5)).tolist(), strict=True))]
    )
    assert drift == pytest.approx(5e-5, abs=3e-6)


def test_nothing_is_lost_and_the_recording_is_cut_into_parts(tmp_path, monkeypatch):
    domain, lock = take_domain()
    monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
    with lock:
        # a topic keeps the 40 blocks for a node that a crowded machine lets stand for seconds
        found = soak(1.0, 0.25, 400_000, tmp_path, size=500)
    print('\n'.join(found.lines()))
    assert not found.lost
    assert found.parts >= 3
    assert set(found.recorded.values()) == {found.samples}
    for name in ('stage', 'excitation', 'recorder'):
        first, last, _, _ = found.memory[name]
        assert last - first < 50.0, f'{name} grew from {first} to {last} MB'
