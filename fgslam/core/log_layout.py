"""The file of a measurement log: its versions, and its arrays with what their rows count."""

from __future__ import annotations

from fgslam.core.array_files import ArrayFile, Items
from fgslam.core.errors import MeasurementLogError

LOG = ArrayFile(
    name="fgslam measurement log",
    # 2: without loops, 3: without corrections of the rig, 6: without the bias of a gyroscope.
    versions=(2, 3, 6, 7),
    error=MeasurementLogError,
    give="give a run folder's measurements.npz",
    again="run again",
)
BEFORE_LOOPS, WITH_LOOPS, WITH_CORRECTIONS, WITH_EVERYTHING = LOG.versions
CORRECTIONS, SENSOR_POSE = "rig_correction", "rig_bTc"

# Arrays by the count that their first axis has, with type and the shape of an item.
PER_FRAME: Items = {
    "frame_index": ("i", ()),
    "timestamp": ("f", ()),
    "odometry_motion": ("f", (4, 4)),
    "odometry_covariance": ("f", (6, 6)),
}
PER_OBSERVATION: Items = {
    "observation_id": ("i", ()),
    "measurement": ("f", (3,)),
    "measurement_covariance": ("f", (6,)),
    "pixels": ("f", (3, 2)),
    "is_new": ("b", ()),
    "rejected": ("b", ()),
}
LOOPS = "loop_"  # before the names of the arrays of the loops' own observations
PER_LOOP: Items = {
    "loop_frame": ("i", ()),
    "loop_oTc": ("f", (4, 4)),
    "loop_covariance": ("f", (6, 6)),
}
PER_TURN: Items = {
    "gyroscope_jacobian": ("f", (3, 3)),
    "gyroscope_bias": ("f", (3,)),
    "gyroscope_bias_covariance": ("f", (3, 3)),
    "gyroscope_stability": ("f", (2,)),
}
