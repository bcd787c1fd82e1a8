# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""An effect of one's own: the stage runs into a soft stop."""

import numpy as np
from piezo_ident.effects import Effect, Parameter


class SoftStop(Effect):
    """
    Beyond a displacement the stage is stiffer: ``y = x - k max(0, x - s)``.

    Notes
    -----
    Two springs side by side from s on; k is the share of the second.
    """

    name = 'soft_stop'
    slot = 'output'
    description = 'the stage runs into something soft near the end of its travel'
    needs = 'a slow sweep over the full range'
    parameters = (
        Parameter('gain', '1', 'share k', 0.0, 0.0, 1.0, default=0.0, step=0.01),
        Parameter('stop', '1', 'place s', float('nan'), 0.0, 2.0, tries=(0.5, 0.7, 0.9)),
    )

    def reset(self, v0, x0):
        return float(self._stopped(x0))

    def process(self, block):
        return block.with_signal(self._stopped(block.x))

    def _stopped(self, x):
        return x - self.number('gain') * np.maximum(0.0, x - self.number('stop'))
