"""A live robot: each frame's processor time through `Slam.track`, at 640x480 with two cameras.

Frames are of the rendered lab, 30 a second; everything is the default, on one thread of linear
algebra; the rig is taken to be as a calibration states it. Raw SIFT is timed on every tenth frame
within the same run.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

import fgslam as fg
from benchmarks.runs import EXPERIMENTS, plain_sift
from fgslam.core.kernels import make_kernels
from fgslam.frontend.settings import SiftSettings
from fgslam.runs.config import load_config
from fgslam.runs.opening import open_sequence

FRAMES, LAP = 240, 300
_RATE_HZ = 30.0
_SET = (
    f"dataset.drive.frames={LAP}", "dataset.drive.laps=1", "dataset.rig.width=640",
    "dataset.rig.height=480", "dataset.rig.vertical_baseline_m=null",
)  # fmt: skip
LIMITS = {"live_ms_median": 33.0, "live_ms_99": 100.0, "live_worst_over_median": 5.0}
"""The milliseconds are those of a quiet machine."""


def over_live(frames: int) -> dict[str, float]:
    """Milliseconds of the processor a frame, the first one left out, and their ratios."""
    stop = f"dataset.stop={min(frames, FRAMES)}"
    sequence = open_sequence(load_config(EXPERIMENTS / "lab_laps.yaml", [*_SET, stop]))
    images = [sequence.frame(i).images for i in range(len(sequence))]
    make_kernels(lambda *_: None)
    slam, sift = fg.Slam(dataclasses.replace(sequence.rig, exact=False)), plain_sift(SiftSettings())
    ms, alone = [], []
    for i, (right, left) in enumerate(images):
        start = time.process_time()
        slam.track(i / _RATE_HZ, (left, right))
        ms.append(1e3 * (time.process_time() - start))
        if i % 10 == 0:
            start = time.process_time()
            for image in (right, left):
                sift.detectAndCompute(image, None)
            alone.append(1e3 * (time.process_time() - start))
    median, raw = float(np.median(ms[1:])), float(np.median(alone))
    high, worst = float(np.percentile(ms[1:], 99)), max(ms[1:])
    return {
        "live_ms_median": median,
        "live_ms_99": high,
        "live_worst_over_median": worst / median,
        "live_median_over_sift": median / raw,
        "live_99_over_sift": high / raw,
    }
