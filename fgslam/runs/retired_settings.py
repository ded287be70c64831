"""Settings of version 0.1 that are constants now, with the values that they have.

Configurations, run folders and saved maps of that version name them. With these values they mean
the same as without; other values are refused.
"""

from __future__ import annotations

from typing import Any

_TRACKING = {
    "max_points": 50,
    "max_view_width": 720,
    "sigma_px": 0.2,
    "pyramid_levels": 2,
    "iterations": 15,
    "precision_px": 0.03,
    "max_back_px": 1.0,
    "min_eigenvalue": 0.0001,
    "patch_px": 13,
    "patch_deformation": 0.05,
    "max_deformation": 1.0,
    "sigma_deformed_px": 1.0,
    "search_px": 3.0,
    "plane_error": 0.2,
    "distinct_px": 3.0,
    "patch_noise_grey": 4.0,
    "min_correlation": 0.7,
    "window_px": 9,
}
"""A group of omnidirectional tracking, all of which is constant."""

_ADMISSION = {
    "weak_prior_ranges": 2.0,
    "least_sightings": 2,
    "least_parallax": 3.0,
    "weak_parallax": 8.0,
    "contradicted_after": 3,
}
"""Of landmarks to the graph of any smoother."""

_LOOPS = {
    "gate_sigmas": 10.0,
    "submap_frames": 10,
    "drift_factor": 1.0,
    "closure_factor": 3.0,
}
"""Of every estimator that corrects: which loop closures it accepts."""

_COLUMNS = {
    "sigma_px": 1.8,
    "max_width": 2048,
    "max_tangent": 1.0,
    "smoothing_px": 1.2,
    "min_length_px": 8.0,
    "min_length_tangent": 0.05,
    "min_contrast": 4.0,
    "min_run_px": 2,
    "max_run_deg": 8.0,
    "run_step_px": 1.5,
    "sigma_run": 0.15,
    "min_gradient": 4.0,
}
"""Of the invariant column segments, all of which are constant."""

RETIRED: dict[str, dict[str, Any]] = {
    "HomingPairsConfig": {
        "both_ways": False,
    },
    "QuerySettings": {
        "least_visible": 20,
        "wrong_m": 0.3,
        "wrong_deg": 5.0,
    },
    "OmniFeatureSettings": {
        "columns": _COLUMNS,
    },
    "ViewpointSettings": {
        "view_angle_deg": 20.0,
    },
    "DetectionSettings": {
        "min_range_m": 0.4,
        "oblique_deg": 75.0,
        "prune_after_misses": 20,
    },
    "LabPersonSettings": {
        "distance_m": 1.8,
    },
    "RandomPosesSettings": {
        "step_m": 0.1,
    },
    "LabBlurSettings": {
        "samples": 5,
    },
    "LabExposureSettings": {
        "wave_period_frames": 60.0,
        "jump_frame": 125,
    },
    "HouseLightSettings": {
        "warmth": 0.0,
        "evening": 0.0,
    },
    "AvoidanceSettings": {
        "look_ahead_m": 0.6,
        "look_ahead_s": 1.5,
        "max_turn_deg_s": 40.0,
        "directions": 72,
        "keep_weight": 0.5,
        "gain_per_s": 2.0,
        "escape_after": 20,
        "escape_steps": 20,
        "escape_m": 1.2,
        "escape_mps": 0.25,
    },
    "BatchSettings": {
        "loops": _LOOPS,
        **_ADMISSION,
        "max_iterations": 100,
    },
    "BloggieSettings": {
        "view_deg": 60.0,
        "above_horizon": 0.8,
    },
    "ColourMomentSettings": {
        "mean_floor": 8.0,
        "patch_sigmas": 6.0,
    },
    "DatabaseSettings": {
        "cone_deg": 30.0,
    },
    "EgoMotionSettings": {
        "max_iterations": 15,
        "kernel_width": 2.0,
    },
    "EkfSettings": {
        "loops": _LOOPS,
        "loop_gate_sigmas": 10.0,
    },
    "EurocSettings": {
        "rectify_alpha": 0.0,
    },
    "FilterMotionSettings": {
        "initial_speed": 0.5,
    },
    "FixedLagSettings": {
        "loops": _LOOPS,
        **_ADMISSION,
        "relinearize_threshold": 0.01,
    },
    "GraphMotionSettings": {
        "initial_speed": 0.5,
        "initial_turning_deg": 30.0,
    },
    "GraphSettings": {
        **_ADMISSION,
    },
    "HomingConfig": {
        "tracking": _TRACKING,
    },
    "HomingBehaviourSettings": {
        "path": {"skip_unmatched": True, "max_skips": 1},
    },
    "HomingControlSettings": {
        "give_up_s": 3.0,
        "farther_tries": 3,
        "wait_s": 60.0,
        "max_turn_deg_s": 120.0,
        "blind_s": 1.0,
        "stall_s": 15.0,
        "pass_fraction": 0.25,
        "fewest_tracks": 4,
        "max_across": 0.1,
        "max_residual_deg": 5.0,
        "blind_heading_deg": 20.0,
        "farther_s": 2.5,
        "contradiction_deg": 30.0,
        "max_stalls": 3,
        "near_fraction": 0.3,
        "min_tracks": 10,
    },
    "HomingGraphSettings": {
        "lag_s": 1.0,
        "prior_distances": 2.0,
        "relinearize_threshold": 0.01,
        "trust_radius": 1.0,
        "max_iterations": 50,
        "match_limit": 13.8,
        "max_steps": 1,
    },
    "HomingVectorSettings": {
        "inlier_sigmas": 3.0,
        "least_parallax_deg": 3.0,
    },
    "HouseExposureSettings": {
        "gain": 1.25,
        "period_s": 20.0,
        "offset": 0.0,
        "gamma": 1.0,
    },
    "HouseMirrorSettings": {
        "xi": 0.92,
        "top_elevation_deg": 15.0,
        "bottom_elevation_deg": -65.0,
    },
    "HousePathSettings": {
        "clearance_m": 0.55,
    },
    "HouseTiltSettings": {
        "period_s": 7.0,
    },
    "Isam2Settings": {
        "loops": _LOOPS,
        **_ADMISSION,
        "relinearize_threshold": 0.01,
        "final_iterations": 5,
        "relinearize_skip": 1,
    },
    "LabDriveSettings": {
        "max_acceleration_m_s2": 0.3,
    },
    "LightFieldSettings": {
        "metres_per_unit": 0.001,
    },
    "LandmarkKalmanGraphSettings": {
        "loops": _LOOPS,
        "miss_growth_m": 0.0001,
    },
    "LandmarkKalmanSettings": {
        "loops": _LOOPS,
        "miss_growth_m": 0.0001,
    },
    "LocalisationSettings": {
        "background": 4.0,
        "stay": 0.5,
    },
    "LoopSettings": {
        "max_drift_m": 0.5,
        "max_drift_deg": 10.0,
        "max_drift_deg_m": 0.25,
        "fuse_m": 0.1,
        "agreement_m": 0.15,
        "agreement_deg": 2.0,
        "least_offset_m": 0.03,
        "least_offset_deg": 0.3,
    },
    "MapMatchingSettings": {
        "window_px": 5.0,
        "disparity_px": 2.0,
        "max_window_px": 80.0,
        "orientation_deg": 20.0,
        "scale_ratio": 1.5,
    },
    "OmniHouseSettings": {
        "wheelchair": {
            "latency_s": 0.1,
            "slip_m_sqrt_m": 0.02,
            "slip_deg_sqrt_m": 1.0,
            "max_acceleration_m_s2": 0.5,
            "max_turn_acceleration_deg_s2": 120.0,
            "max_speed_m_s": 0.5,
            "max_turn_deg_s": 45.0,
            "speed_scale": 0.03,
            "turn_scale": 0.03,
            "pull_deg_m": 1.0,
            "radius_m": 0.35,
        },
        "camera_height_m": 1.2,
        "door_width_m": 1.6,
        "range_sensor": {
            "beams": 32,
            "heights_m": [0.15, 0.45, 0.72, 1.0],
            "max_range_m": 5.0,
            "noise_m": 0.02,
        },
        "target_light": {"level": 0.9, "warmth": 0.04, "evening": 0.3},
        "target_exposure": {
            "gain": 1.25,
            "wave": 0.0,
            "period_s": 20.0,
            "offset": 0.0,
            "gamma": 1.0,
        },
    },
    "OmniMatchingSettings": {
        "horizon_margin_deg": 3.0,
        "max_scale_ratio": 2.0,
        "max_column_distance": 4.4,
        "column_ratio": 0.7,
    },
    "OmniVideoConfig": {
        "tracking": _TRACKING,
    },
    "PathFollowingConfig": {
        "tracking": _TRACKING,
    },
    "PermanenceSettings": {
        "apart_px": 2.0,
        "near_px": 40.0,
    },
    "RecordedOdometrySettings": {
        "translation_floor_m": 0.002,
        "rotation_floor_deg": 0.1,
    },
    "RelocalisationSettings": {
        "view_sigma_px": 0.3,
        "min_inliers": 8,
        "samples": 4096,
        "neighbours": 12,
        "max_distance": 400.0,
        "ratio": 0.85,
        "candidates": 3,
        "same_place_m": 0.3,
        "size_ratio": 1.6,
        "orientation_deg": 30.0,
        "height_m": 0.05,
        "hypotheses": 64,
        "rounds": 6,
        "confidence": 0.999,
        "bin_m": 0.3,
        "bin_deg": 5.0,
        "bins": 16,
        "refined": 4,
        "piece_m": 0.5,
        "gate_sigmas": 4.0,
        "enough_witnesses": 36,
        "max_misfit": 1.2,
        "least_agreement": 0.57,
        "least_covered": 0.5,
        "ambiguous_share": 0.5,
        "ambiguous_own": 0.2,
        "view_deg": 20.0,
        "elsewhere_m": 0.5,
        "elsewhere_deg": 15.0,
    },
    "SiftSettings": {
        "edge_threshold": 10.0,
    },
    "SimulatedBearingsSettings": {
        "wrong_matches": 0.0,
        "jumping_tracks": 0.0,
        "gross_bearings": 0.0,
        "nearest_m": 0.8,
        "farthest_m": 2.5,
        "lowest_m": 0.2,
        "highest_m": 1.5,
        "direction_deg": 20.0,
        "rotation_deg": 30.0,
        "speed_mps": 0.3,
        "wander_deg": 10.0,
        "slip": 0.05,
    },
    "SteeringSettings": {
        "acceleration_mps2": 0.5,
        "turn_acceleration_deg_s2": 120.0,
        "turn_in_place_deg": 60.0,
        "slow_fraction": 0.3,
        "least_share": 0.25,
        "passing_share": 0.6,
        "blind_share": 0.4,
        "gain_per_s": 1.2,
    },
    "SyntheticOdometrySettings": {
        "translation_floor_m": 0.001,
        "rotation_floor_deg": 0.01,
    },
    "TopologicalMapSettings": {
        "retrieval": {"words": 400, "sample": 10000, "iterations": 6},
        "one_way_support": 25,
        "lone_support": 50,
        "mutual_deg": 5.0,
        "loop_deg": 6.0,
        "heading_deg": 15.0,
        "doubling_support": 25.0,
        "third_views": 1.0,
        "order_reach": 3,
        "min_support": 12,
    },
    "UprightSiftSettings": {
        "sigma_px": 1.2,
        "octave_layers": 3,
        "edge_threshold": 10.0,
        "base_sigma_px": 1.6,
        "max_view_width": 2048,
        "sigma_scales": 0.27,
    },
    "UtiasRangeBearingSettings": {
        "lateral_sigma_mps": 0.03,
        "rate_sigma_scale": 1.0,
    },
    "UtiasStereoSettings": {
        "pixel_sigma_scale": 1.0,
        "rate_sigma_scale": 1.0,
    },
    "WheelOdometrySettings": {
        "height_m_sqrt_m": 0.002,
        "tilt_deg_sqrt_m": 0.1,
        "floor_m": 1e-4,
        "floor_deg": 0.01,
    },
    "WhiteWheelOdometrySettings": {
        "height_m_sqrt_m": 0.002,
        "tilt_deg_sqrt_m": 0.1,
        "floor_m": 1e-4,
        "floor_deg": 0.01,
    },
}
"""By the class of the group: key and value."""
