"""A whole `fgslam compare` over KITTI's tracks: 77 frames, 15,638 landmarks, on the clock.

Replays in processes of their own one after the other, judgement, files and page, as a user waits
for it. The joint EKF is left out: its covariance of so many landmarks would take 17 GB.
"""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path

from benchmarks.runs import EXPERIMENTS
from fgslam.runs.compare import Choice, all_kinds, compare_runs
from fgslam.runs.config import load_config
from fgslam.runs.run import run_experiment

LIMITS = {"compare_kitti00_s": 60.0, "compare_kitti00_cpu_s": 60.0}
"""On a busy machine the clock says nothing; replays come one after the other, so that on an idle
one it shows little more than the processor's time."""
_LEFT_OUT = {"odometry", "ekf"}
"""Without odometry dead reckoning has no motion; the other does not hold the map."""


def seconds_of_comparing() -> dict[str, float]:
    """Seconds on the clock and of the processor; of every estimator its own, with its answer.

    Raises:
        RuntimeError: an estimator failed, so that the whole is not what it should be.
    """
    names = tuple(name for name in all_kinds() if name not in _LEFT_OUT)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        run_experiment(load_config(EXPERIMENTS / "kitti00_tracks.yaml", ("compare=[]",)), run)
        clock, processor = time.perf_counter(), _processor_s()
        (result,) = compare_runs([run], Choice(names))
        clock, processor = time.perf_counter() - clock, _processor_s() - processor
        estimators = result.metrics["estimators"]
    failed = [name for name, numbers in estimators.items() if numbers["failure"]]
    if failed or set(estimators) != set(names):
        raise RuntimeError(f"compared {sorted(estimators)}, of which {failed} failed")
    return {"compare_kitti00_s": clock, "compare_kitti00_cpu_s": processor}


def _processor_s() -> float:
    """Seconds of this process and of those that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
