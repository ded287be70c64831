"""Pictures of a run, as PNG: overlays on images, and figures on paper; no global state is kept."""
