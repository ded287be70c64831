"""Estimators: measurements to trajectories, maps and covariances."""
