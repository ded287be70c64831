"""Errors against the truth, consistency, time: of trajectories, landmarks, closures, homings."""
