"""Results for people and for other tools: figures, pages, point clouds, trajectories, graphs."""
