"""SLAM: the loop over frames, what it is built from, and the replay of its measurement log."""
