"""The run folder, trajectories, point clouds and pictures."""
