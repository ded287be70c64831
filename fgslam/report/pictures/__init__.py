"""Pictures of a run, as PNG: the figures of Se, Lowe and Little (2001), and the errors over time.

Every function takes plain arrays and a path, returns nothing, and writes one file atomically; the
same input gives the same bytes.
"""

from fgslam.report.pictures.birds_eye import MapDrawing, draw_birds_eye
from fgslam.report.pictures.curves import draw_errors, draw_matches
from fgslam.report.pictures.image_overlays import draw_disparities, draw_features, draw_flow
from fgslam.report.pictures.map_views import draw_map_views

__all__ = [
    "MapDrawing",
    "draw_birds_eye",
    "draw_disparities",
    "draw_errors",
    "draw_features",
    "draw_flow",
    "draw_map_views",
    "draw_matches",
]
