"""Learns focal points."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...planning.evidence import BATCHES, gain_of
from ...planning.learner import Learner, Pilot
from ...planning.pixel_estimates import PixelEstimates
from ...planning.prediction import Effect, Prediction
from ...scene.bounds import scene_bounds
from .decisions import FocalScattering
from .fitting import fitted
from .focal_boxes import FocalBoxes
from .line_records import LineRecords

MOST_LINES = 8192


class FocalLearner(Learner):
    def __init__(self, bounces, stride, film_size, always=False):
        self._bounces, self.always = bounces, always
        self._pixels = PixelEstimates(*film_size)
        self._records = LineRecords(bounces, stride, self._pixels)
        self.decision = None
        self._summary = "no focal points"

    def start(self, scene, p, n):
        box = scene_bounds(scene)
        self._bounds = np.array(box.min, np.float64), np.array(box.max, np.float64)
        low, high = self._bounds
        self.decision = FocalScattering(FocalBoxes(low[None], high[None] + 1e-6, np.ones(1)), 0.0)
        return self.decision

    def kernel_state(self):
        return [self._records]

    def begin(self, *a): self._records.begin(*a)
    def direction(self, *a): self._records.direction(*a)
    def scattering(self, *a): self._records.scattering(*a)
    def end(self, L): self._records.end(L)

    def learn(self, pilot: Pilot):
        import time
        t0 = time.time()
        records = self._records
        records.finish()
        lines = records.lines
        if lines is None:
            return self.decision
        share, boxes = self.decision.share, self.decision.boxes
        focus = boxes.density(lines.p, lines.d, mi.Bool(True))
        n = dr.width(lines.pdf)
        new = n - records.first_new
        # density of the BSDF
        s = dr.opaque(mi.Float, share)
        if not hasattr(self, "bsdf"):
            self.bsdf = mi.Float()
        index = dr.arange(mi.UInt32, new) + records.first_new
        b = dr.maximum((dr.gather(mi.Float, lines.pdf, index) - s * dr.gather(mi.Float, focus, index)) / (1 - s), 0)
        self.bsdf = dr.concat([self.bsdf, b]) if len(self.bsdf) else b
        dr.eval(self.bsdf)
        v = lines.value.numpy()
        pdf, bs, batch = lines.pdf.numpy(), self.bsdf.numpy(), lines.batch.numpy()
        # effect of the last stage
        if share > 0 and new:
            i = slice(records.first_new, None)
            sq = v[i].astype(float)**2
            ratio = np.minimum(pdf[i] / np.maximum(bs[i], 1e-9), 1e6)
            more = np.bincount(batch[i], sq * (ratio - 1), BATCHES)
            gain, err = gain_of(np.stack([records.variances, more]))
            print(f"   measured gain {gain:.3f} ± {err:.2f}; variance left {1-gain:.3f}")
        import os
        if os.environ.get("DBG"):
            import sys; sys.path.insert(0,"/tmp/FOCAL"); import patch; patch.debug(records, lines, bs, boxes, share)
        # weights
        c = v.astype(float)
        cap = 64 * c.mean()
        c = np.minimum(c, cap)
        cum = np.cumsum(c) / c.sum()
        m = min(MOST_LINES, n)
        pick = np.minimum(np.searchsorted(cum, (np.arange(m) + 0.5) / m), n - 1)
        pick, times = np.unique(pick, return_counts=True)
        P = lines.p.numpy().T[pick]; D = lines.d.numpy().T[pick]
        low, high, a, new_share = fitted(self._bounds, P, D, bs[pick].astype(np.float32), times.astype(np.float32), lambda *x: print("   ", *x))
        records.restart()
        share = min(max(new_share, 0.0), 0.9)
        self.decision = FocalScattering(FocalBoxes(low, high, a), share)
        self._summary = f"{len(a)} boxes, share {share:.2f}"
        print("   ", n, "lines", self._summary, f"{time.time()-t0:.2f} s")
        return self.decision

    def state(self):
        b = self.decision.boxes
        return {"low": b.low, "high": b.high, "weight": b.weight.astype(np.float32), "share": np.float32(self.decision.share)}

    def restore(self, scene, state):
        low = state.take("low", "f", (None, 3), longest=1 << 20)
        n = len(low)
        high = state.take("high", "f", (n, 3))
        w = state.take("weight", "f", (n,))
        self.decision = FocalScattering(FocalBoxes(low, high, w), float(state.take("share", "f", (), 0, 1)))
        return self.decision

    def finish(self):
        self._records = None

    @property
    def effect(self):
        return Effect(True)

    def __str__(self):
        return self._summary
