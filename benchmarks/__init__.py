"""What the project measures: speed as ratios, accuracy beside bounds, and the pages of results."""
